#![allow(clippy::unwrap_used)]

use super::*;
use crate::masks::drawn::{bit, deletable, masks};

struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }
}

fn random_volume(size: [usize; 3], percent: u64, random: &mut Random) -> BitVolume {
    let mut v = BitVolume::new(size);
    for k in 0..size[2] {
        for j in 0..size[1] {
            for i in 0..size[0] {
                if random.next() % 100 < percent {
                    v.set([i, j, k]);
                }
            }
        }
    }
    v
}

/// The definition, voxel by voxel on the whole volume: no queue, no words, no early border test.
fn slow_reference(volume: &BitVolume) -> (BitVolume, usize) {
    let mut v = volume.clone();
    let mut subiterations = 0;
    let mut idle = 0;
    while idle < 6 {
        let set = masks(Direction::ALL[subiterations % 6]);
        let matched: Vec<[usize; 3]> = v
            .voxels()
            .filter(|&p| {
                let mut n = 0;
                for d in (0..27).map(|b| [b % 3 - 1, b / 3 % 3 - 1, b / 9 - 1]) {
                    let q =
                        [p[0] as isize + d[0] as isize, p[1] as isize + d[1] as isize, p[2] as isize + d[2] as isize];
                    n |= u32::from(v.at(q)) << bit(d);
                }
                deletable(&set, n)
            })
            .collect();
        idle = if matched.is_empty() { idle + 1 } else { 0 };
        for p in matched {
            v.clear(p);
        }
        subiterations += 1;
    }
    (v, subiterations)
}

/// (26-components of the object, 6-components of the background, Euler number) with a background margin.
fn betti(v: &BitVolume) -> (usize, usize, i64) {
    let size = v.size().map(|n| n + 2);
    let at = |p: [usize; 3]| v.at([p[0] as isize - 1, p[1] as isize - 1, p[2] as isize - 1]);
    let mut parts = [0, 0];
    let mut seen = BitVolume::new(size);
    for start in (0..size.iter().product()).map(|n| [n % size[0], n / size[0] % size[1], n / size[0] / size[1]]) {
        if seen.get(start) {
            continue;
        }
        let object = at(start);
        parts[usize::from(object)] += 1;
        seen.set(start);
        let mut stack = vec![start];
        while let Some(p) = stack.pop() {
            for d in (0..27_isize).map(|b| [b % 3 - 1, b / 3 % 3 - 1, b / 9 - 1]) {
                if !object && d.iter().map(|x| x.abs()).sum::<isize>() != 1 {
                    continue;
                }
                let q: [usize; 3] = std::array::from_fn(|a| p[a].wrapping_add_signed(d[a]));
                if (0..3).all(|a| q[a] < size[a]) && at(q) == object && !seen.get(q) {
                    seen.set(q);
                    stack.push(q);
                }
            }
        }
    }
    (parts[1], parts[0], euler(v))
}

/// Euler number of the union of closed voxel cubes: vertices - edges + faces - cubes, on the doubled lattice.
fn euler(v: &BitVolume) -> i64 {
    let n = v.size().map(|n| 2 * n + 1);
    let mut chi = 0;
    for c in (0..n.iter().product()).map(|i: usize| [i % n[0], i / n[0] % n[1], i / n[0] / n[1]]) {
        let span = |a: usize| if c[a] % 2 == 1 { [c[a] / 2; 2] } else { [(c[a] / 2).wrapping_sub(1), c[a] / 2] };
        let (x, y, z) = (span(0), span(1), span(2));
        let touched = x.iter().any(|&i| y.iter().any(|&j| z.iter().any(|&k| v.get([i, j, k]))));
        if touched {
            chi += if c.iter().filter(|&&x| x % 2 == 1).count() % 2 == 0 { 1 } else { -1 };
        }
    }
    chi
}

#[test]
fn random_volumes_thin_to_the_slow_reference_and_keep_their_topology() {
    let ctx = [Ctx::new(1).unwrap(), Ctx::new(3).unwrap()];
    let mut random = Random(7);
    let widths = [1, 2, 5, 17, 31, 63, 64, 65, 66, 127, 130];
    for round in 0..200_usize {
        let size = [widths[round % widths.len()], 1 + round % 9, 1 + round * 5 % 11];
        let volume = random_volume(size, [20, 50, 80, 90, 97, 100][round % 6], &mut random);
        let (expected, subiterations) = slow_reference(&volume);
        let mut fast = volume.clone();
        let report = thin(&mut fast, &ctx[round % 2]).unwrap();
        assert_eq!(fast, expected, "round {round}, size {size:?}");
        assert_eq!(report.subiterations, subiterations);
        assert_eq!(report.deleted + report.remaining, volume.count());
        if round % 4 == 0 {
            assert_eq!(betti(&fast), betti(&volume), "round {round}, size {size:?}");
        }
    }
}

#[test]
fn the_same_bits_for_any_number_of_threads() {
    let volume = random_volume([200, 60, 50], 95, &mut Random(3));
    let thinned = [1, 2, 3].map(|threads| {
        let mut v = volume.clone();
        thin(&mut v, &Ctx::new(threads).unwrap()).unwrap();
        v
    });
    assert!(thinned[0] == thinned[1] && thinned[0] == thinned[2]);
}

#[test]
fn a_solid_torus_thins_to_one_closed_line() {
    let mut v = BitVolume::new([70, 70, 24]);
    for p in (0..70 * 70 * 24).map(|n| [n % 70, n / 70 % 70, n / 4900]) {
        let [x, y, z] = [p[0] as f64 - 35.2, p[1] as f64 - 34.7, p[2] as f64 - 11.9];
        if (x.hypot(y) - 22.0).hypot(z) < 8.0 {
            v.set(p);
        }
    }
    let report = thin(&mut v, &Ctx::new(2).unwrap()).unwrap();
    assert_eq!(betti(&v), (1, 1, 0));
    assert!(report.remaining > 100 && report.remaining < 200, "{report:?}");
}

#[test]
fn a_single_voxel_stays_and_an_empty_volume_is_left_alone() {
    let ctx = Ctx::new(1).unwrap();
    let mut v = BitVolume::new([3, 3, 3]);
    assert_eq!(thin(&mut v, &ctx).unwrap(), ThinReport { subiterations: 6, deleted: 0, remaining: 0 });
    v.set([1, 1, 1]);
    assert_eq!(thin(&mut v, &ctx).unwrap().remaining, 1);
    let mut none = BitVolume::new([0, 4, 4]);
    assert_eq!(thin(&mut none, &ctx).unwrap().remaining, 0);
}

#[test]
fn cancelled_thinning_says_so() {
    let ctx = Ctx::new(1).unwrap();
    ctx.cancel();
    let mut v = random_volume([20, 20, 20], 90, &mut Random(5));
    assert_eq!(thin(&mut v, &ctx), Err(Error::Cancelled));
}
