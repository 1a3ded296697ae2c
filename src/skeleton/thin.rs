//! Thinning a binary volume to medial lines.
//!
//! The 6-subiteration algorithm of Palágyi and Kuba (1998, see the masks), (26, 6): in the order U, D, N, S, E, W all
//! object voxels that match a mask of the direction are found on one image and deleted at once, until six
//! subiterations in a row delete nothing. The result keeps the topology (proved over all neighbourhoods in the tests of
//! the masks), is deterministic and does not depend on the number of threads.
//!
//! The 64 voxels of a word are tested at once, as boolean algebra on the 27 words around it. A voxel can only begin to
//! match when its neighbourhood changed, so a queue per direction holds the words next to a deletion since they were
//! last tested: one byte per word of the volume and 4 per queued word, 2 MiB and some 3 MiB at 512^3 for a vessel that
//! fills 1 %. Rejected: a bit per voxel and direction of what must be tested again, with the voxels tested one by one
//! (some twice as long at 512^3, 56 bytes per word), four words at a time in SIMD lanes on a copy with a margin (as fast, 36
//! instead of 5 MiB), and a list of border voxels (8 bytes each).

use crate::masks::{Direction, matches};
use crate::{BitVolume, Error};
use exec::Ctx;

/// Queued words per parallel piece, and the queue length below which one thread does it all: a piece of this size takes
/// some 20 microseconds, several times what handing it to a thread costs.
const PIECE: usize = 1024;
/// Flags of a word that waits in every direction's queue.
const EVERY: u8 = 0x3f;

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
/// Cost: some .15 microseconds per deleted voxel on one thread for a vessel of 28 voxels radius (docs/accuracy.md has
/// the table beside other programs); memory as in the module's text.
pub fn thin(volume: &mut BitVolume, ctx: &Ctx) -> Result<ThinReport, Error> {
    if volume.words().len() > u32::MAX as usize {
        let voxels = volume.size().iter().map(|&n| n as u128).product();
        return Err(Error::TooManyVoxels { voxels, spacing_mm: f64::NAN, limit: 1 << 38 });
    }
    let before = volume.count();
    let mut queue = Queue::new(volume);
    let mut report = ThinReport::default();
    let mut idle = 0;
    while idle < Direction::ALL.len() {
        let direction = Direction::ALL[report.subiterations % Direction::ALL.len()];
        let matched = queue.matches(volume, direction, ctx)?;
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
    /// For each word of the volume a bit per direction: it is in that direction's queue.
    queued: Vec<u8>,
    /// Queued words, per direction.
    waiting: [Vec<u32>; 6],
}

impl Queue {
    fn new(volume: &BitVolume) -> Self {
        let words = volume.words();
        let queued = words.iter().map(|&w| if w == 0 { 0 } else { EVERY }).collect();
        let all: Vec<u32> = (0..words.len()).filter(|&w| words[w] != 0).map(|w| w as u32).collect();
        Self { queued, waiting: std::array::from_fn(|_| all.clone()) }
    }

    /// The words with their bits that match, on the present image; the direction's queue is empty afterwards.
    fn matches(&mut self, volume: &BitVolume, direction: Direction, ctx: &Ctx) -> Result<Vec<(u32, u64)>, Error> {
        let d = direction as usize;
        let mut waiting = std::mem::take(&mut self.waiting[d]);
        let test = |piece: &[u32]| match direction {
            Direction::Up => matches_in::<{ Direction::Up as usize }>(volume, piece),
            Direction::Down => matches_in::<{ Direction::Down as usize }>(volume, piece),
            Direction::North => matches_in::<{ Direction::North as usize }>(volume, piece),
            Direction::South => matches_in::<{ Direction::South as usize }>(volume, piece),
            Direction::East => matches_in::<{ Direction::East as usize }>(volume, piece),
            Direction::West => matches_in::<{ Direction::West as usize }>(volume, piece),
        };
        let found = if waiting.len() <= PIECE || ctx.threads() == 1 {
            ctx.check()?;
            test(&waiting)
        } else {
            let pieces: Vec<&[u32]> = waiting.chunks(PIECE).collect();
            ctx.map(&pieces, |piece| test(piece))?.concat()
        };
        for &word in &waiting {
            self.queued[word as usize] &= !(1 << d);
        }
        waiting.clear();
        self.waiting[d] = waiting;
        Ok(found)
    }

    /// Queue the words that hold the 26 neighbours of the deleted bits of a word, in every direction.
    fn touch_around(&mut self, volume: &BitVolume, word: usize, bits: u64) {
        let [_, ny, nz] = volume.size();
        let n = volume.words_per_row();
        let (row, x) = (word / n, word % n);
        let (j, k) = (row % ny, row / ny);
        let from = if bits & 1 != 0 && x > 0 { x - 1 } else { x };
        let to = if bits >> 63 != 0 && x + 1 < n { x + 1 } else { x };
        for kk in k.saturating_sub(1)..(k + 2).min(nz) {
            for jj in j.saturating_sub(1)..(j + 2).min(ny) {
                let first = volume.row(jj, kk);
                (first + from..=first + to).for_each(|w| self.touch(volume, w));
            }
        }
    }

    fn touch(&mut self, volume: &BitVolume, word: usize) {
        let missing = EVERY & !self.queued[word];
        if missing == 0 || volume.words()[word] == 0 {
            return;
        }
        for (d, waiting) in self.waiting.iter_mut().enumerate() {
            if missing >> d & 1 == 1 {
                waiting.push(word as u32);
            }
        }
        self.queued[word] = EVERY;
    }
}

/// The words of a piece with their bits that match a mask of direction `D`.
fn matches_in<const D: usize>(volume: &BitVolume, piece: &[u32]) -> Vec<(u32, u64)> {
    let mut found = Vec::with_capacity(piece.len());
    for &word in piece {
        let bits = around::<D>(volume, word as usize).map_or(0, |n| matches::<D>(&n));
        if bits != 0 {
            found.push((word, bits));
        }
    }
    found
}

/// The 27 words around a word: bit b of word (dx + 1) + 3 (dy + 1) + 9 (dz + 1) is the voxel at (dx, dy, dz) from voxel
/// b. `None` where no object voxel of the word has background towards `D`.
#[inline(always)]
fn around<const D: usize>(volume: &BitVolume, word: usize) -> Option<[u64; 27]> {
    let [_, ny, nz] = volume.size();
    let (n, words) = (volume.words_per_row(), volume.words());
    let (row, x) = (word / n, word % n);
    let (j, k) = (row % ny, row / ny);
    let three = |dj: usize, dk: usize| {
        let (jj, kk) = (j + dj, k + dk);
        if jj == 0 || jj > ny || kk == 0 || kk > nz {
            return [0; 3];
        }
        let at = ((kk - 1) * ny + jj - 1) * n + x;
        let before = if x > 0 { words[at - 1] >> 63 } else { 0 };
        let after = if x + 1 < n { words[at + 1] << 63 } else { 0 };
        let here = words[at];
        [here << 1 | before, here, here >> 1 | after]
    };
    let towards = match Direction::ALL[D] {
        Direction::Up => three(1, 2)[1],
        Direction::Down => three(1, 0)[1],
        Direction::North => three(2, 1)[1],
        Direction::South => three(0, 1)[1],
        Direction::East => three(1, 1)[2],
        Direction::West => three(1, 1)[0],
    };
    if words[word] & !towards == 0 {
        return None;
    }
    let mut a = [0; 27];
    for r in 0..9 {
        a[3 * r..3 * r + 3].copy_from_slice(&three(r % 3, r / 3));
    }
    Some(a)
}

#[cfg(test)]
mod tests;
