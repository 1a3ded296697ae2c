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

/// The neighbour of voxel `i` in a lattice of size `n`, where there is one.
pub(crate) fn neighbour(i: usize, d: [i32; 3], n: [usize; 3]) -> Option<usize> {
    let p = [i % n[0], i / n[0] % n[1], i / n[0] / n[1]];
    let mut q = [0usize; 3];
    for a in 0..3 {
        q[a] = p[a].checked_add_signed(d[a] as isize).filter(|&x| x < n[a])?;
    }
    Some(q[0] + n[0] * (q[1] + n[1] * q[2]))
}

/// Whether two voxels share a face.
pub(crate) fn is_face(d: [i32; 3]) -> bool {
    d[0].abs() + d[1].abs() + d[2].abs() == 1
}

/// The set reached from `seeds` over voxels that are `open`, by all 26 neighbours; ascending indices.
pub(crate) fn reached(seeds: Vec<usize>, open: &mut [bool], n: [usize; 3]) -> Vec<usize> {
    let mut out = Vec::new();
    let mut todo: Vec<usize> = seeds.into_iter().filter(|&i| std::mem::replace(&mut open[i], false)).collect();
    while let Some(i) = todo.pop() {
        out.push(i);
        for d in NEIGHBOURS {
            if let Some(j) = neighbour(i, d, n)
                && std::mem::replace(&mut open[j], false)
            {
                todo.push(j);
            }
        }
    }
    out.sort_unstable();
    out
}

/// Face-connected components of at least `least` voxels of an `open` set, each ascending, in the order of their first
/// voxels. Empties `open`.
pub(crate) fn components(open: &mut [bool], n: [usize; 3], least: usize) -> Vec<Vec<u32>> {
    let mut out = Vec::new();
    let mut todo = Vec::new();
    for start in 0..open.len() {
        if !std::mem::replace(&mut open[start], false) {
            continue;
        }
        let mut found = Vec::new();
        todo.push(start);
        while let Some(i) = todo.pop() {
            found.push(i as u32);
            for d in NEIGHBOURS.into_iter().filter(|&d| is_face(d)) {
                if let Some(j) = neighbour(i, d, n)
                    && std::mem::replace(&mut open[j], false)
                {
                    todo.push(j);
                }
            }
        }
        if found.len() >= least {
            found.sort_unstable();
            out.push(found);
        }
    }
    out
}

/// Voxels outside a set that it surrounds within some slice of the lattice, whichever way that is cut: what lies within
/// a section of a lumen, also where the lumen runs out of the lattice and the hollow with it.
pub(crate) fn surrounded(set: &[bool], n: [usize; 3]) -> Vec<bool> {
    let stride = [1, n[0], n[0] * n[1]];
    let mut out = vec![false; set.len()];
    for across in 0..3 {
        let [a, b] = [(across + 1) % 3, (across + 2) % 3];
        let (mut open, mut todo) = (vec![false; n[a] * n[b]], Vec::new());
        for k in 0..n[across] {
            let at = |i: usize| k * stride[across] + i % n[a] * stride[a] + i / n[a] * stride[b];
            open.iter_mut().enumerate().for_each(|(i, o)| *o = !set[at(i)]);
            todo.extend((0..n[a]).flat_map(|i| [i, i + n[a] * (n[b] - 1)]));
            todo.extend((0..n[b]).flat_map(|j| [n[a] * j, n[a] * j + n[a] - 1]));
            while let Some(i) = todo.pop() {
                if !std::mem::replace(&mut open[i], false) {
                    continue;
                }
                let (x, y) = (i % n[a], i / n[a]);
                todo.extend((x > 0).then(|| i - 1));
                todo.extend((x + 1 < n[a]).then(|| i + 1));
                todo.extend((y > 0).then(|| i - n[a]));
                todo.extend((y + 1 < n[b]).then(|| i + n[a]));
            }
            (0..open.len()).filter(|&i| open[i]).for_each(|i| out[at(i)] = true);
        }
    }
    out
}

/// Distance value of voxels farther than the limit.
pub(crate) const FAR: u8 = u8::MAX;

/// Path length (26 neighbours) from the nearest voxel of `from` to every voxel up to `limit`, in the unit in which
/// `step` is given (integers after rounding); [`FAR`] beyond. Dial's bucket queue: cost grows with the voxels reached.
pub(crate) fn distances(from: &[bool], n: [usize; 3], step: [f64; 3], limit: u8) -> Vec<u8> {
    let weight = NEIGHBOURS.map(|d| {
        let l = (0..3).map(|a| (f64::from(d[a]) * step[a]).powi(2)).sum::<f64>().sqrt();
        l.round().max(1.0) as usize
    });
    let mut out: Vec<u8> = from.iter().map(|&s| if s { 0 } else { FAR }).collect();
    let limit = usize::from(limit.min(FAR - 1));
    let mut buckets: Vec<Vec<usize>> = vec![Vec::new(); limit + 1];
    // Only seeds with a neighbour outside can reach anything.
    buckets[0] = (0..from.len())
        .filter(|&i| from[i] && NEIGHBOURS.iter().any(|&d| is_face(d) && neighbour(i, d, n).is_some_and(|j| !from[j])))
        .collect();
    for at in 0..=limit {
        for i in std::mem::take(&mut buckets[at]) {
            if usize::from(out[i]) != at {
                continue;
            }
            for (d, w) in NEIGHBOURS.into_iter().zip(weight) {
                let far = at + w;
                if far <= limit
                    && let Some(j) = neighbour(i, d, n)
                    && usize::from(out[j]) > far
                {
                    out[j] = far as u8;
                    buckets[far].push(j);
                }
            }
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
    fn a_hollow_that_runs_out_of_the_lattice_is_surrounded_and_a_groove_is_not() {
        let n = [5, 5, 4];
        let index = |x: usize, y: usize, z: usize| x + 5 * (y + 5 * z);
        let ring = |x: usize, y: usize| (1..4).contains(&x) && (1..4).contains(&y) && (x, y) != (2, 2);
        let mut set: Vec<bool> = (0..100).map(|i| ring(i % 5, i / 5 % 5)).collect();
        let within: Vec<usize> = (0..100).filter(|&i| surrounded(&set, n)[i]).collect();
        assert_eq!(within, [0, 1, 2, 3].map(|z| index(2, 2, z)));
        (0..4).for_each(|z| set[index(3, 2, z)] = false);
        assert!(!surrounded(&set, n).contains(&true));
    }

    #[test]
    fn components_are_face_connected_and_reach_is_by_corners() {
        let n = [4, 4, 1];
        let set = |on: &[usize]| (0..16).map(|i| on.contains(&i)).collect::<Vec<bool>>();
        assert_eq!(components(&mut set(&[0, 1, 6]), n, 1), vec![vec![0, 1], vec![6]]);
        assert_eq!(reached(vec![0], &mut set(&[0, 1, 6, 15]), n), vec![0, 1, 6]);
    }
}
