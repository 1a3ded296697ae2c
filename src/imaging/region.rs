//! Sets of voxels: connected components and distances up to a limit.

/// The 26 neighbour offsets of a voxel as (dx, dy, dz).
pub(crate) const NEIGHBOURS: [[i32; 3]; 26] = neighbours();

const fn neighbours() -> [[i32; 3]; 26] {
    let mut out = [[0; 3]; 26];
    let (mut k, mut i) = (0, 0);
    while k < 27 {
        if k != 13 {
            out[i] = [k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1];
            i += 1;
        }
        k += 1;
    }
    out
}

/// The voxels around a voxel in a lattice. Offsets are made once: away from the lattice's faces, where nearly all voxels
/// lie, a visit costs additions only (divisions for every neighbour took a quarter of the segmentation's time).
#[derive(Clone, Copy)]
pub(crate) struct Around {
    n: [usize; 3],
    offsets: [isize; 26],
}

/// Those of [`NEIGHBOURS`] that share a face, with the axis along which they lie.
const FACES: [(usize, usize); 6] = [(4, 2), (10, 1), (12, 0), (13, 0), (15, 1), (21, 2)];

impl Around {
    pub(crate) fn new(n: [usize; 3]) -> Self {
        let stride = [1, n[0] as isize, (n[0] * n[1]) as isize];
        let offsets = NEIGHBOURS.map(|d| (0..3).map(|a| d[a] as isize * stride[a]).sum());
        Self { n, offsets }
    }
    fn place(&self, i: usize) -> ([usize; 3], bool) {
        let row = i / self.n[0];
        let p = [i % self.n[0], row % self.n[1], row / self.n[1]];
        (p, (0..3).all(|a| p[a] > 0 && p[a] + 1 < self.n[a]))
    }
    fn has(&self, p: [usize; 3], k: usize) -> bool {
        (0..3).all(|a| p[a].checked_add_signed(NEIGHBOURS[k][a] as isize).is_some_and(|x| x < self.n[a]))
    }
    /// Calls `f(k, j)` for every neighbour j of voxel i, k its number in [`NEIGHBOURS`].
    pub(crate) fn visit(&self, i: usize, mut f: impl FnMut(usize, usize)) {
        let (p, inner) = self.place(i);
        for k in 0..26 {
            if inner || self.has(p, k) {
                f(k, i.wrapping_add_signed(self.offsets[k]));
            }
        }
    }
    /// Calls `f(axis, j)` for every voxel j that shares a face with voxel i.
    pub(crate) fn visit_faces(&self, i: usize, mut f: impl FnMut(usize, usize)) {
        let (p, inner) = self.place(i);
        for (k, axis) in FACES {
            if inner || self.has(p, k) {
                f(axis, i.wrapping_add_signed(self.offsets[k]));
            }
        }
    }
}

/// The set reached from `seeds` over voxels that are `open`, by all 26 neighbours; ascending indices.
pub(crate) fn reached(seeds: Vec<usize>, open: &mut [bool], n: [usize; 3]) -> Vec<usize> {
    let mut out = Vec::new();
    let mut todo: Vec<usize> = seeds.into_iter().filter(|&i| std::mem::replace(&mut open[i], false)).collect();
    let around = Around::new(n);
    while let Some(i) = todo.pop() {
        out.push(i);
        around.visit(i, |_, j| {
            if std::mem::replace(&mut open[j], false) {
                todo.push(j);
            }
        });
    }
    out.sort_unstable();
    out
}

/// Face-connected components of at least `least` voxels of an `open` set, each ascending, in the order of their first
/// voxels. Empties `open`.
pub(crate) fn components(open: &mut [bool], n: [usize; 3], least: usize) -> Vec<Vec<u32>> {
    let mut out = Vec::new();
    let mut todo = Vec::new();
    let around = Around::new(n);
    for start in 0..open.len() {
        if !std::mem::replace(&mut open[start], false) {
            continue;
        }
        let mut found = Vec::new();
        todo.push(start);
        while let Some(i) = todo.pop() {
            found.push(i as u32);
            around.visit_faces(i, |_, j| {
                if std::mem::replace(&mut open[j], false) {
                    todo.push(j);
                }
            });
        }
        if found.len() >= least {
            found.sort_unstable();
            out.push(found);
        }
    }
    out
}

/// Distance value of voxels farther than the limit.
pub(crate) const FAR: u8 = u8::MAX;

/// Path length (26 neighbours) from the nearest voxel of `from` to every voxel up to `limit`, in the unit in which
/// `step` is given (integers after rounding); [`FAR`] beyond. Dial's bucket queue: cost grows with the voxels reached.
pub(crate) fn distances(from: &[bool], n: [usize; 3], step: [f64; 3], limit: u8) -> Vec<u8> {
    flooded(from, n, step, limit, |_, _| {})
}

/// [`distances`], and for every voxel reached the voxel of `from` whence it was reached ([`NOWHERE`] for the others).
pub(crate) fn distances_and_sources(from: &[bool], n: [usize; 3], step: [f64; 3], limit: u8) -> (Vec<u8>, Vec<u32>) {
    let mut source: Vec<u32> = (0..from.len()).map(|i| if from[i] { i as u32 } else { NOWHERE }).collect();
    let d = flooded(from, n, step, limit, |i, j| source[j] = source[i]);
    (d, source)
}

/// Source of a voxel that was not reached.
pub(crate) const NOWHERE: u32 = u32::MAX;

/// The flood behind [`distances`]; `reach(i, j)` is told that j is reached from i, the last time by its shortest way.
fn flooded(from: &[bool], n: [usize; 3], step: [f64; 3], limit: u8, mut reach: impl FnMut(usize, usize)) -> Vec<u8> {
    let weight = NEIGHBOURS.map(|d| {
        let l = (0..3).map(|a| (f64::from(d[a]) * step[a]).powi(2)).sum::<f64>().sqrt();
        l.round().max(1.0) as usize
    });
    let mut out: Vec<u8> = from.iter().map(|&s| if s { 0 } else { FAR }).collect();
    let limit = usize::from(limit.min(FAR - 1));
    let mut buckets: Vec<Vec<usize>> = vec![Vec::new(); limit + 1];
    let around = Around::new(n);
    // Only seeds with a neighbour outside can reach anything.
    let on_rim = |&i: &usize| {
        let mut rim = false;
        around.visit_faces(i, |_, j| rim |= !from[j]);
        rim
    };
    buckets[0] = (0..from.len()).filter(|&i| from[i]).filter(on_rim).collect();
    for at in 0..=limit {
        for i in std::mem::take(&mut buckets[at]) {
            if usize::from(out[i]) != at {
                continue;
            }
            around.visit(i, |k, j| {
                let far = at + weight[k];
                if far <= limit && usize::from(out[j]) > far {
                    out[j] = far as u8;
                    reach(i, j);
                    buckets[far].push(j);
                }
            });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_count_steps_and_stop_at_the_limit() {
        let n = [9, 5, 3];
        let mut from = vec![false; 135];
        from[9 * 5 + 18] = true; // (0, 2, 1)
        let d = distances(&from, n, [10.0, 10.0, 30.0], 42);
        let at = |x: usize, y: usize, z: usize| d[x + 9 * (y + 5 * z)];
        assert_eq!([at(0, 2, 1), at(3, 2, 1), at(4, 2, 1), at(5, 2, 1)], [0, 30, 40, FAR]);
        assert_eq!([at(1, 3, 1), at(0, 2, 2), at(1, 2, 0)], [14, 30, 32]);
    }

    #[test]
    fn components_are_face_connected_and_reach_is_by_corners() {
        let n = [4, 4, 1];
        let set = |on: &[usize]| (0..16).map(|i| on.contains(&i)).collect::<Vec<bool>>();
        assert_eq!(components(&mut set(&[0, 1, 6]), n, 1), vec![vec![0, 1], vec![6]]);
        assert_eq!(reached(vec![0], &mut set(&[0, 1, 6, 15]), n), vec![0, 1, 6]);
    }
}
