//! A binary volume in one bit per voxel.
//!
//! x runs fastest and every row is padded to whole 64-bit words, so that a row's neighbours in y and z are whole words
//! too and 64 voxels can be looked at at once. 512^3 voxels take 16 MiB (one byte per voxel would take 128 MiB).
//! Padding bits are always 0: everything outside the volume is background.

/// A binary volume, bit-packed. Voxel (i, j, k) is object or background; everything outside is background.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BitVolume {
    size: [usize; 3],
    words_per_row: usize,
    words: Vec<u64>,
}

impl BitVolume {
    /// An empty (all background) volume of `size` voxels along x, y and z.
    pub fn new(size: [usize; 3]) -> Self {
        let words_per_row = size[0].div_ceil(64);
        Self { size, words_per_row, words: vec![0; words_per_row * size[1] * size[2]] }
    }
    /// Voxels along x, y and z.
    pub fn size(&self) -> [usize; 3] {
        self.size
    }
    /// 64-bit words per row of x.
    pub fn words_per_row(&self) -> usize {
        self.words_per_row
    }
    /// The words: row after row, y before z; the lowest bit is the smallest x.
    pub fn words(&self) -> &[u64] {
        &self.words
    }
    pub(crate) fn words_mut(&mut self) -> &mut [u64] {
        &mut self.words
    }
    /// First word of the row (j, k).
    pub(crate) fn row(&self, j: usize, k: usize) -> usize {
        (k * self.size[1] + j) * self.words_per_row
    }
    /// Whether voxel (i, j, k) is object; background outside.
    pub fn get(&self, v: [usize; 3]) -> bool {
        (0..3).all(|a| v[a] < self.size[a]) && self.words[self.row(v[1], v[2]) + v[0] / 64] >> (v[0] % 64) & 1 == 1
    }
    /// Whether the voxel is object; negative indices are outside, hence background.
    pub fn at(&self, v: [isize; 3]) -> bool {
        match (usize::try_from(v[0]), usize::try_from(v[1]), usize::try_from(v[2])) {
            (Ok(i), Ok(j), Ok(k)) => self.get([i, j, k]),
            _ => false,
        }
    }
    /// Make voxel (i, j, k) object. Outside the volume nothing happens.
    pub fn set(&mut self, v: [usize; 3]) {
        if (0..3).all(|a| v[a] < self.size[a]) {
            let w = self.row(v[1], v[2]) + v[0] / 64;
            self.words[w] |= 1 << (v[0] % 64);
        }
    }
    /// Make voxel (i, j, k) background.
    pub fn clear(&mut self, v: [usize; 3]) {
        if (0..3).all(|a| v[a] < self.size[a]) {
            let w = self.row(v[1], v[2]) + v[0] / 64;
            self.words[w] &= !(1 << (v[0] % 64));
        }
    }
    /// Number of object voxels.
    pub fn count(&self) -> usize {
        // most words are empty, and counting bits takes ten times as long as seeing that
        self.words.iter().filter(|w| **w != 0).map(|w| w.count_ones() as usize).sum()
    }
    /// The object voxels, x fastest, then y, then z.
    pub fn voxels(&self) -> impl Iterator<Item = [usize; 3]> + '_ {
        self.words.iter().enumerate().flat_map(move |(w, &word)| {
            let (row, first) = (w / self.words_per_row, w % self.words_per_row * 64);
            let (j, k) = (row % self.size[1], row / self.size[1]);
            Bits(word).map(move |b| [first + b, j, k])
        })
    }
}

/// The positions of the set bits of a word, ascending.
pub(crate) struct Bits(pub(crate) u64);

impl Iterator for Bits {
    type Item = usize;
    fn next(&mut self) -> Option<usize> {
        if self.0 == 0 {
            return None;
        }
        let b = self.0.trailing_zeros() as usize;
        self.0 &= self.0 - 1;
        Some(b)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_come_back_at_word_borders_and_nothing_exists_outside() {
        for nx in [1, 63, 64, 65, 129] {
            let mut v = BitVolume::new([nx, 3, 2]);
            let wanted = [[0, 0, 0], [nx - 1, 2, 0], [nx / 2, 1, 1], [nx - 1, 2, 1]];
            for p in wanted {
                v.set(p);
            }
            v.set([nx, 0, 0]);
            let mut sorted = wanted.to_vec();
            sorted.sort_by_key(|p| (p[2], p[1], p[0]));
            sorted.dedup();
            assert_eq!(v.voxels().collect::<Vec<_>>(), sorted);
            assert_eq!(v.count(), sorted.len());
            assert!(!v.get([nx, 2, 1]) && !v.at([-1, 0, 0]) && v.at([0, 0, 0]));
            v.clear([0, 0, 0]);
            assert!(!v.get([0, 0, 0]));
        }
    }
}
