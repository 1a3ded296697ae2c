//! Thinning a binary volume to medial lines.
//!
//! The 6-subiteration algorithm of Palágyi and Kuba (1998, see the masks), (26, 6): in the order U, D, N, S, E, W all
//! object voxels that match a mask of the direction are found on one image and deleted at once, until six
//! subiterations in a row delete nothing. The result keeps the topology (proved over all neighbourhoods in the tests of
//! the masks), is deterministic and does not depend on the number of threads.
//!
//! A voxel can only begin to match when its neighbourhood changed, so each word of 64 voxels keeps, per direction, the
//! bits that must be tested again, and a queue per direction holds the words that have any. Only words that hold object
//! at the start get such a record (56 bytes each), plus 4 bytes per word of the volume: 8 MiB at 512^3 with some
//! 3 MiB for a vessel that fills 1 %. A list of border voxels would take 8 bytes for each of them.

use crate::bits::Bits;
use crate::masks::{Direction, Mask, Neighbourhood, deletable, masks};
use crate::{BitVolume, Error};
use exec::Ctx;

/// Queued words per parallel piece, and the queue length below which one thread does it all: a piece of this size takes
/// some 20 microseconds, a hundred times what handing it to a thread costs.
const PIECE: usize = 256;
const NO_SLOT: u32 = u32::MAX;

/// What thinning did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ThinReport {
    /// Subiterations run, the last six without effect.
    pub subiterations: usize,
    /// Voxels deleted.
    pub deleted: usize,
    /// Object voxels that remain.
    pub remaining: usize,
}

/// Delete voxels of `volume` until medial lines remain: same components, cavities and tunnels as before, one voxel wide
/// except where lines meet. Ends of lines lie about one radius short of where the object ended, lines up to 1.3 voxel
/// off the axis, and bumps of the wall may leave spurs. Lines may depend on the order of the directions by a voxel.
///
/// # Errors
/// [`Error::Cancelled`] when asked to stop (`volume` is then partly thinned), [`Error::TooManyVoxels`] above 2^38
/// voxels.
///
/// Cost: some 0.6 microseconds per deleted voxel on one thread (measured at 128^3 to 512^3 without release
/// optimisation across crates); memory as in the module's text.
pub fn thin(volume: &mut BitVolume, ctx: &Ctx) -> Result<ThinReport, Error> {
    if volume.words().len() >= NO_SLOT as usize {
        let voxels = volume.size().iter().map(|&n| n as u128).product();
        return Err(Error::TooManyVoxels { voxels, spacing_mm: f64::NAN, limit: 1 << 38 });
    }
    let before = volume.count();
    let all_masks = Direction::ALL.map(masks);
    let mut queue = Queue::new(volume);
    let mut report = ThinReport::default();
    let mut idle = 0;
    while idle < Direction::ALL.len() {
        let direction = report.subiterations % Direction::ALL.len();
        let matched = queue.matches(volume, direction, &all_masks[direction], ctx)?;
        for &(word, bits) in &matched {
            volume.words_mut()[word as usize] &= !bits;
        }
        for &(word, bits) in &matched {
            queue.touch_around(volume, word as usize, bits);
        }
        idle = if matched.is_empty() { idle + 1 } else { 0 };
        report.subiterations += 1;
    }
    report.remaining = volume.count();
    report.deleted = before - report.remaining;
    ctx.progress(1.0);
    Ok(report)
}

/// The words that must be looked at again, per direction.
struct Queue {
    /// Record of each word of the volume, or [`NO_SLOT`].
    slot: Vec<u32>,
    /// Word of each record.
    word: Vec<u32>,
    /// Bits to be tested again, per record and direction.
    dirty: Vec<[u64; 6]>,
    /// Records with any such bit, per direction.
    waiting: [Vec<u32>; 6],
}

impl Queue {
    fn new(volume: &BitVolume) -> Self {
        let mut slot = vec![NO_SLOT; volume.words().len()];
        let mut word = Vec::new();
        let mut dirty = Vec::new();
        for (w, &bits) in volume.words().iter().enumerate().filter(|(_, bits)| **bits != 0) {
            slot[w] = word.len() as u32;
            word.push(w as u32);
            dirty.push([bits; 6]);
        }
        let all: Vec<u32> = (0..word.len() as u32).collect();
        let waiting = std::array::from_fn(|_| all.clone());
        Self { slot, word, dirty, waiting }
    }

    /// The words with their bits that match, on the present image; the direction's queue is empty afterwards.
    fn matches(
        &mut self,
        volume: &BitVolume,
        direction: usize,
        masks: &[Mask],
        ctx: &Ctx,
    ) -> Result<Vec<(u32, u64)>, Error> {
        let waiting = std::mem::take(&mut self.waiting[direction]);
        let test = |&slot: &u32| {
            let word = self.word[slot as usize];
            let bits = matches_in_word(volume, word as usize, self.dirty[slot as usize][direction], direction, masks);
            (bits != 0).then_some((word, bits))
        };
        let found: Vec<(u32, u64)> = if waiting.len() <= PIECE {
            ctx.check()?;
            waiting.iter().filter_map(test).collect()
        } else {
            let pieces: Vec<&[u32]> = waiting.chunks(PIECE).collect();
            ctx.map(&pieces, |piece| piece.iter().filter_map(test).collect::<Vec<_>>())?.concat()
        };
        for &slot in &waiting {
            self.dirty[slot as usize][direction] = 0;
        }
        Ok(found)
    }

    /// Mark the 26 neighbours of the deleted bits of a word, in every direction.
    fn touch_around(&mut self, volume: &BitVolume, word: usize, bits: u64) {
        let [_, ny, nz] = volume.size();
        let n = volume.words_per_row();
        let (row, x) = (word / n, word % n);
        let (j, k) = (row % ny, row / ny);
        let spread = bits | bits << 1 | bits >> 1;
        for kk in k.saturating_sub(1)..(k + 2).min(nz) {
            for jj in j.saturating_sub(1)..(j + 2).min(ny) {
                let first = volume.row(jj, kk);
                self.touch(volume, first + x, spread);
                if bits & 1 != 0 && x > 0 {
                    self.touch(volume, first + x - 1, 1 << 63);
                }
                if bits >> 63 != 0 && x + 1 < n {
                    self.touch(volume, first + x + 1, 1);
                }
            }
        }
    }

    fn touch(&mut self, volume: &BitVolume, word: usize, bits: u64) {
        let bits = bits & volume.words()[word];
        if bits == 0 {
            return;
        }
        let slot = self.slot[word];
        for (dirty, waiting) in self.dirty[slot as usize].iter_mut().zip(&mut self.waiting) {
            if *dirty == 0 {
                waiting.push(slot);
            }
            *dirty |= bits;
        }
    }
}

/// The bits of a word that are object, dirty and match a mask.
fn matches_in_word(volume: &BitVolume, word: usize, dirty: u64, direction: usize, masks: &[Mask]) -> u64 {
    let object = volume.words()[word] & dirty;
    if object == 0 {
        return 0;
    }
    let around = Around::new(volume, word);
    Bits(object & !around.towards(direction))
        .filter(|&b| deletable(masks, around.neighbourhood(b)))
        .fold(0, |m, b| m | 1 << b)
}

/// The nine rows of words around a word, and the same shifted so that bit b is the voxel at x - 1 or x + 1.
struct Around {
    west: [u64; 9],
    here: [u64; 9],
    east: [u64; 9],
}

impl Around {
    fn new(volume: &BitVolume, word: usize) -> Self {
        let [_, ny, nz] = volume.size();
        let (n, words) = (volume.words_per_row(), volume.words());
        let (row, x) = (word / n, word % n);
        let (j, k) = (row % ny, row / ny);
        let mut a = Self { west: [0; 9], here: [0; 9], east: [0; 9] };
        for r in 0..9 {
            let (jj, kk) = (j + r % 3, k + r / 3);
            if jj == 0 || jj > ny || kk == 0 || kk > nz {
                continue;
            }
            let at = volume.row(jj - 1, kk - 1) + x;
            let before = if x > 0 { words[at - 1] } else { 0 };
            let after = if x + 1 < n { words[at + 1] } else { 0 };
            a.here[r] = words[at];
            a.west[r] = words[at] << 1 | before >> 63;
            a.east[r] = words[at] >> 1 | after << 63;
        }
        a
    }

    /// Bit b is the face neighbour of voxel b in the direction.
    fn towards(&self, direction: usize) -> u64 {
        match Direction::ALL[direction] {
            Direction::Up => self.here[7],
            Direction::Down => self.here[1],
            Direction::North => self.here[5],
            Direction::South => self.here[3],
            Direction::East => self.east[4],
            Direction::West => self.west[4],
        }
    }

    fn neighbourhood(&self, b: usize) -> Neighbourhood {
        (0..9).fold(0, |n, r| {
            let three = self.west[r] >> b & 1 | (self.here[r] >> b & 1) << 1 | (self.east[r] >> b & 1) << 2;
            n | (three as u32) << (3 * r)
        })
    }
}

#[cfg(test)]
mod tests;
