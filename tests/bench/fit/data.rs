//! The files that the programs exchange: little-endian f64.

use space::P3;
use std::error::Error;

/// Constraints: points and wanted values.
pub(crate) struct Data {
    pub(crate) points: Vec<P3>,
    pub(crate) values: Vec<f64>,
}

pub(crate) type Outcome<T> = Result<T, Box<dyn Error>>;

pub(crate) fn numbers(path: &str) -> Outcome<Vec<f64>> {
    Ok(std::fs::read(path)?.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect())
}

pub(crate) fn write(path: &str, numbers: impl IntoIterator<Item = f64>) -> Outcome<()> {
    Ok(std::fs::write(path, numbers.into_iter().flat_map(f64::to_le_bytes).collect::<Vec<u8>>())?)
}

impl Data {
    /// Rows of x, y, z (scaled: mean 0, farthest point at 1) and value (mm).
    pub(crate) fn read(path: &str) -> Outcome<Self> {
        let rows = numbers(path)?;
        let rows = rows.as_chunks::<4>().0;
        Ok(Self {
            points: rows.iter().map(|&[x, y, z, _]| P3::new(x, y, z)).collect(),
            values: rows.iter().map(|r| r[3]).collect(),
        })
    }
}

/// Prints the most memory that this process has held. What the kernel tells the parent of it starts with what the parent
/// held itself when it forked.
pub(crate) fn show_peak() -> Outcome<()> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:")).ok_or("no VmHWM")?;
    let kib: f64 = line.trim().trim_end_matches("kB").trim().parse()?;
    println!("peak {}", 1024.0 * kib);
    Ok(())
}
