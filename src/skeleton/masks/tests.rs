//! The exhaustive proof that one parallel subiteration keeps the topology.
//!
//! What it proves. A point x of a set P of object points is P-simple (Bertrand 1995, "On P-simple points") when x is
//! simple in X minus S for every subset S of P without x; deleting any subset of a set of P-simple points keeps the
//! topology. P is the set of all points that a subiteration deletes. Whether a neighbour y of x is in P depends on
//! voxels outside the 3x3x3 neighbourhood of x, so y is counted as a member whenever no voxel that is known rules out
//! all masks for y. That set holds the true P for every image, and P-simplicity for a set implies it for its subsets:
//! checked for all 2^26 neighbourhoods, it is a proof for all images. The local test of P-simplicity is Bertrand's
//! characterisation for (26, 6), which is itself compared here with the definition on a sample.
#![allow(clippy::unwrap_used)]

use super::*;
use crate::masks::drawn::{Mask, bit, deletable, masks};
use exec::Ctx;

const CENTRE: u32 = 1 << 13;

fn step(b: u32) -> [i32; 3] {
    let b = b as i32;
    [b % 3 - 1, b / 3 % 3 - 1, b / 9 - 1]
}

/// For every voxel the other voxels of the cube within a distance: 26- and 6-adjacency.
struct Adjacency {
    near26: [u32; 27],
    near6: [u32; 27],
    within6: u32,
    within18: u32,
}

fn adjacency() -> Adjacency {
    let mut a = Adjacency { near26: [0; 27], near6: [0; 27], within6: 0, within18: 0 };
    for p in 0..27 {
        for q in (0..27).filter(|&q| q != p) {
            let d: Vec<i32> = (0..3).map(|i| (step(p)[i] - step(q)[i]).abs()).collect();
            if d.iter().all(|&x| x <= 1) {
                a.near26[p as usize] |= 1 << q;
            }
            if d.iter().sum::<i32>() == 1 {
                a.near6[p as usize] |= 1 << q;
            }
        }
        match step(p).iter().map(|x| x.abs()).sum::<i32>() {
            1 => {
                a.within6 |= 1 << p;
                a.within18 |= 1 << p;
            }
            2 => a.within18 |= 1 << p,
            _ => {}
        }
    }
    a
}

fn grow(seed: u32, within: u32, near: &[u32; 27]) -> u32 {
    let (mut piece, mut front) = (seed, seed);
    while front != 0 {
        let b = front.trailing_zeros() as usize;
        front &= front - 1;
        let fresh = near[b] & within & !piece;
        piece |= fresh;
        front |= fresh;
    }
    piece
}

impl Adjacency {
    /// One 26-component of `object` among the 26 neighbours.
    fn one_object(&self, object: u32) -> bool {
        object != 0 && grow(object & object.wrapping_neg(), object, &self.near26) == object
    }
    /// One 6-component of background within the 18-neighbourhood among those that touch a face of the voxel.
    fn one_background(&self, n: u32) -> bool {
        let back = !n & self.within18;
        let faces = back & self.within6;
        faces != 0 && faces & !grow(faces & faces.wrapping_neg(), back, &self.near6) == 0
    }
    fn simple(&self, n: u32) -> bool {
        self.one_object(n & !CENTRE) && self.one_background(n)
    }
    /// Bertrand's four conditions for x to be P-simple, (26, 6); `p` are the neighbours in P.
    fn p_simple(&self, n: u32, p: u32) -> bool {
        let rest = n & !p & !CENTRE;
        let touched = (0..27).filter(|&y| p >> y & 1 == 1).all(|y| self.near26[y] & rest != 0);
        self.one_object(rest) && self.one_background(n) && touched && self.squares(n, p)
    }
    /// Every face neighbour y in P has background z at a face and t such that x, y, t, z is a unit square.
    fn squares(&self, n: u32, p: u32) -> bool {
        let back = !n & !CENTRE;
        (0..27).filter(|&y| p & self.within6 & (1 << y) != 0).all(|y| {
            (0..27).filter(|&z| back & self.within6 & (1 << z) != 0).any(|z| {
                let common = self.near6[y] & self.near6[z] & !CENTRE;
                common.count_ones() == 1 && back & common != 0
            })
        })
    }
}

/// The masks of every neighbour y, cut to the voxels of the cube around x: (zero, one, any), any = 0 where a voxel
/// outside may satisfy it.
fn masks_of_neighbours(masks: &[Mask]) -> Vec<Vec<Mask>> {
    (0..27).map(|y| masks.iter().map(|m| shifted(*m, step(y))).collect()).collect()
}

fn shifted(m: Mask, by: [i32; 3]) -> Mask {
    let cut = |bits: u32| {
        let mut out = (0, false);
        for b in (0..27).filter(|&b| bits >> b & 1 == 1) {
            let d: [i32; 3] = std::array::from_fn(|i| step(b)[i] + by[i]);
            if d.iter().all(|x| x.abs() <= 1) {
                out.0 |= 1 << bit(d);
            } else {
                out.1 = true;
            }
        }
        out
    };
    let (any, unknown) = cut(m.any);
    Mask { zero: cut(m.zero).0, one: cut(m.one).0, any: if unknown { 0 } else { any } }
}

/// The object neighbours that may be deleted together with x, whatever lies outside the cube.
fn possible(n: u32, of: &[Vec<Mask>]) -> u32 {
    (0..27).filter(|&y| y != 13 && n >> y & 1 == 1 && deletable(&of[y as usize], n)).fold(0, |p, y| p | 1 << y)
}

fn neighbourhood(code: u32) -> u32 {
    code & 0x1fff | CENTRE | (code >> 13) << 14
}

#[test]
fn all_2_to_26_neighbourhoods_keep_the_topology() {
    let masks = masks(Direction::Up);
    let (of, near) = (masks_of_neighbours(&masks), adjacency());
    let ctx = Ctx::new(0).unwrap();
    let counts = ctx
        .map_range(1 << 10, |block| {
            let mut count = [0_u32; 4];
            for low in 0..1 << 16 {
                let n = neighbourhood((block as u32) << 16 | low);
                if !deletable(&masks, n) {
                    continue;
                }
                count[0] += 1;
                count[1] += u32::from(near.simple(n));
                count[2] += u32::from((n & !CENTRE).count_ones() > 1);
                count[3] += u32::from(near.p_simple(n, possible(n, &of)));
            }
            count
        })
        .unwrap();
    let total = counts.iter().fold([0; 4], |t: [u32; 4], c| std::array::from_fn(|i| t[i] + c[i]));
    assert_eq!(total, [2_124_283; 4], "deletable, simple, not an end point, P-simple");
}

#[test]
fn the_local_test_of_p_simplicity_agrees_with_its_definition() {
    let near = adjacency();
    let mut state = 1_u64;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as u32
    };
    let mut seen = [0; 2];
    for round in 0..400_000 {
        let density = if round % 2 == 0 { next() & next() } else { next() };
        let n = neighbourhood(density & 0x3ff_ffff);
        let p = n & next() & next() & neighbourhood(0x3ff_ffff) & !CENTRE;
        if p.count_ones() > 8 {
            continue;
        }
        // All subsets of p, by counting down through its bits.
        let mut s = p;
        let by_definition = loop {
            if !near.simple(n & !s) {
                break false;
            }
            if s == 0 {
                break true;
            }
            s = (s - 1) & p;
        };
        assert_eq!(near.p_simple(n, p), by_definition, "{n:027b} {p:027b}");
        seen[usize::from(by_definition)] += 1;
    }
    assert!(seen[0] > 1000 && seen[1] > 1000, "{seen:?}");
}

#[test]
fn every_direction_has_21_masks_that_need_background_towards_it_and_are_those_of_up_turned() {
    let up = masks(Direction::Up);
    for d in Direction::ALL {
        let m = masks(d);
        assert_eq!(m.len(), 21);
        let towards = 1 << bit(d.turned([1, 0, 0]));
        assert!(m.iter().all(|m| m.zero & towards != 0), "{d:?}");
        for (a, b) in up.iter().zip(&m) {
            assert_eq!(a.zero.count_ones(), b.zero.count_ones());
        }
    }
    // The set is closed under reflection, so any isometry that takes U to a direction gives the same masks.
    let mirrored = |bits: u32| {
        (0..27).filter(|&b| bits >> b & 1 == 1).fold(0, |o, b| {
            let d = step(b);
            o | 1 << bit([-d[0], d[1], d[2]])
        })
    };
    for m in &up {
        assert!(up.contains(&Mask { zero: mirrored(m.zero), one: mirrored(m.one), any: mirrored(m.any) }));
    }
}

/// The words of 64 neighbourhoods, one per bit.
fn words(of: impl Fn(u32) -> u32) -> [u64; 27] {
    let mut words = [0; 27];
    for b in 0..64 {
        let n = of(b);
        for (v, word) in words.iter_mut().enumerate() {
            *word |= u64::from(n >> v & 1) << b;
        }
    }
    words
}

#[test]
fn the_algebra_on_words_is_the_masks_on_all_2_to_26_neighbourhoods() {
    let set = masks(Direction::Up);
    let ctx = Ctx::new(0).unwrap();
    let differing = ctx
        .map_range(1 << 10, |block| {
            let code = |high: u32, b: u32| neighbourhood(((block as u32) << 16) | (high << 6) | b);
            (0..1 << 10)
                .filter(|&high| {
                    let expected = (0..64).fold(0, |m, b| m | u64::from(deletable(&set, code(high, b))) << b);
                    matches::<0>(&words(|b| code(high, b))) != expected
                })
                .count()
        })
        .unwrap();
    assert_eq!(differing.iter().sum::<usize>(), 0);
}

#[test]
fn the_algebra_of_every_direction_is_its_masks() {
    let mut state = 9_u64;
    for _ in 0..3000 {
        let words: [u64; 27] = std::array::from_fn(|_| {
            let mut next = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                state ^ (state >> 29)
            };
            let (a, b) = (next(), next());
            if next() & 1 == 0 { a & b } else { a }
        });
        let found = [
            matches::<0>(&words),
            matches::<1>(&words),
            matches::<2>(&words),
            matches::<3>(&words),
            matches::<4>(&words),
            matches::<5>(&words),
        ];
        for (d, found) in Direction::ALL.into_iter().zip(found) {
            let set = masks(d);
            let n = |b: u32| (0..27).fold(0, |n, v| n | (((words[v as usize] >> b & 1) as u32) << v));
            let expected = (0..64).fold(0, |m, b| m | u64::from(n(b) & CENTRE != 0 && deletable(&set, n(b))) << b);
            assert_eq!(found, expected, "{d:?}");
        }
    }
}
