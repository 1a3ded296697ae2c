//! The deletion masks of Palágyi and Kuba's 6-subiteration thinning.
//!
//! K. Palágyi, A. Kuba, "A 3D 6-subiteration thinning algorithm for extracting medial lines", Pattern Recognition
//! Letters 19 (1998) 613-627. An object voxel is deleted in the subiteration of a direction when its 3x3x3
//! neighbourhood matches one of that direction's masks: six base masks for U, turned by 0, 90, 180 and 270 degrees
//! about U, 21 distinct ones; the other directions by turning U to them. [`matches`] is their disjunction as boolean
//! algebra on words, so that 64 voxels are tested at once in some 150 operations; the tests hold the masks as the paper
//! draws them and compare all 2^26 neighbourhoods. A table of all neighbourhoods (8 MiB per direction) was not taken: it
//! tests one voxel at a time and leaves the first-level cache.

/// The directions in the order of the subiterations: U is +z, N is +y, E is +x.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Direction {
    Up,
    Down,
    North,
    South,
    East,
    West,
}

impl Direction {
    /// In the order of the paper.
    pub(crate) const ALL: [Self; 6] = [Self::Up, Self::Down, Self::North, Self::South, Self::East, Self::West];

    /// (up, north, east) of the base masks, as lattice steps (dx, dy, dz) when U is turned to this direction.
    const fn turned(self, [u, n, e]: [i32; 3]) -> [i32; 3] {
        match self {
            Self::Up => [e, n, u],
            Self::Down => [e, n, -u],
            Self::North => [e, u, n],
            Self::South => [e, -u, n],
            Self::East => [u, n, e],
            Self::West => [-u, n, e],
        }
    }
}

/// Word of the voxel at a step of -1, 0 or 1 along each axis.
const fn at(d: [i32; 3]) -> usize {
    (d[0] + 1 + 3 * (d[1] + 1) + 9 * (d[2] + 1)) as usize
}

/// (north, east) of the eight voxels around one, a quarter turn apart by two: N, NE, E, SE, S, SW, W, NW.
const RING: [[i32; 2]; 8] = [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]];

/// The ring of a layer (1 towards the direction, 0 the voxel's own, -1 beyond it) as word numbers.
const fn ring(direction: Direction, layer: i32) -> [usize; 8] {
    let mut words = [0; 8];
    let mut i = 0;
    while i < 8 {
        words[i] = at(direction.turned([layer, RING[i][0], RING[i][1]]));
        i += 1;
    }
    words
}

/// Where the words of a direction's three layers are.
struct Layers {
    up: [usize; 8],
    middle: [usize; 8],
    down: [usize; 8],
    above: usize,
    below: usize,
}

impl Layers {
    const fn of(direction: Direction) -> Self {
        Self {
            up: ring(direction, 1),
            middle: ring(direction, 0),
            down: ring(direction, -1),
            above: at(direction.turned([1, 0, 0])),
            below: at(direction.turned([-1, 0, 0])),
        }
    }
}

const LAYERS: [Layers; 6] = [
    Layers::of(Direction::Up),
    Layers::of(Direction::Down),
    Layers::of(Direction::North),
    Layers::of(Direction::South),
    Layers::of(Direction::East),
    Layers::of(Direction::West),
];

/// The object voxels that match one of the 21 masks of direction `D`, of 64 voxels at once: bit b of word
/// (dx + 1) + 3 (dy + 1) + 9 (dz + 1) of `n` is the voxel at (dx, dy, dz) from voxel b.
#[inline(always)]
pub(crate) fn matches<const D: usize>(n: &[u64; 27]) -> u64 {
    let l = const { &LAYERS[D] };
    let u: [u64; 8] = std::array::from_fn(|i| n[l.up[i]]);
    let m: [u64; 8] = std::array::from_fn(|i| n[l.middle[i]]);
    let d: [u64; 8] = std::array::from_fn(|i| n[l.down[i]]);
    let below = n[l.below];
    // M1: nothing above, D, and anything else around or below
    let ring_above = u.iter().fold(0, |a, b| a | b);
    let others = m.iter().chain(&d).fold(0, |a, b| a | b);
    let mut with_below = !ring_above & others;
    let mut without_below = 0;
    for turn in [0, 2, 4, 6] {
        let [north, ne, east, se, south, sw, west, nw] = std::array::from_fn(|i| (i + turn) % 8);
        // M2, M3, M4
        let south_above = u[sw] | u[south] | u[west];
        with_below |= m[north] & !south_above & (!(u[east] | u[se]) | m[east]);
        let all_but_ne = south_above | u[north] | u[east] | u[se] | u[nw];
        with_below |= u[ne] & m[ne] & !all_but_ne;
        // M5, M6
        let south_rows = m[sw] | m[south] | m[se] | d[sw] | d[south] | d[se];
        let any = m[nw] | m[north] | m[ne] | m[west] | m[east] | d[nw] | d[ne] | d[west] | d[east];
        let corner = m[west] | m[sw] | m[south] | d[west] | d[sw] | d[south];
        without_below |= d[north] & (!south_rows & any | !corner & d[east]);
    }
    n[13] & !n[l.above] & (below & with_below | !below & !ring_above & without_below)
}

#[cfg(test)]
pub(crate) mod drawn;
#[cfg(test)]
mod tests;
