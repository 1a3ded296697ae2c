//! The masks as the paper draws them, the oracle of the algebra on words.

use super::Direction;

/// The 27 voxels around and including one: bit (dx + 1) + 3 (dy + 1) + 9 (dz + 1); bit 13 is the voxel itself.
pub(crate) type Neighbourhood = u32;

/// Bit of the voxel at a step of -1, 0 or 1 along each axis.
pub(crate) fn bit(d: [i32; 3]) -> u32 {
    (d[0] + 1 + 3 * (d[1] + 1) + 9 * (d[2] + 1)) as u32
}

/// One mask: all of `zero` must be background, all of `one` object, and where `any` is not empty one of it object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Mask {
    pub(crate) zero: Neighbourhood,
    pub(crate) one: Neighbourhood,
    pub(crate) any: Neighbourhood,
}

impl Mask {
    fn matches(self, n: Neighbourhood) -> bool {
        n & self.zero == 0 && n & self.one == self.one && (self.any == 0 || n & self.any != 0)
    }
}

/// M1 to M6 for direction U: the U layer, the middle layer, the D layer; in each the rows from north to south, in each
/// row the columns from west to east. 0 background, 1 object, x at least one of them object, . either, C the voxel.
const BASE: [[&str; 3]; 6] = [
    ["000 000 000", "xxx xCx xxx", "xxx x1x xxx"],
    ["... 000 000", ".1. .C. ...", "... .1. ..."],
    ["... 00. 00.", ".1. .C1 ...", "... .1. ..."],
    ["001 000 000", "..1 .C. ...", "... .1. ..."],
    ["000 000 000", "xxx xCx 000", "x1x x0x 000"],
    ["000 000 000", "... 0C. 00.", ".1. 001 00."],
];

/// The 21 masks of one direction.
pub(crate) fn masks(direction: Direction) -> Vec<Mask> {
    let mut out = Vec::with_capacity(21);
    for base in BASE {
        for quarter_turns in 0..4 {
            let mask = turned_mask(base, quarter_turns, direction);
            if !out.contains(&mask) {
                out.push(mask);
            }
        }
    }
    out
}

fn turned_mask(base: [&str; 3], quarter_turns: usize, direction: Direction) -> Mask {
    let mut mask = Mask { zero: 0, one: 0, any: 0 };
    for (layer, text) in base.iter().enumerate() {
        for (row, cells) in text.split(' ').enumerate() {
            for (column, cell) in cells.bytes().enumerate() {
                let (mut north, mut east) = (1 - row as i32, column as i32 - 1);
                for _ in 0..quarter_turns {
                    (north, east) = (east, -north);
                }
                let at = 1 << bit(direction.turned([1 - layer as i32, north, east]));
                match cell {
                    b'0' => mask.zero |= at,
                    b'1' => mask.one |= at,
                    b'x' => mask.any |= at,
                    _ => {}
                }
            }
        }
    }
    mask
}

/// Whether a neighbourhood matches one of the masks.
pub(crate) fn deletable(masks: &[Mask], n: Neighbourhood) -> bool {
    masks.iter().any(|m| m.matches(n))
}
