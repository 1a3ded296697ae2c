//! DICOM's run-length encoding (PS3.5 annex G), one grey component of 8, 16 or 32 bits.
//!
//! An own decoder, because that of dicom-rs refuses 32 bits per pixel.

/// Bytes of the header: the number of segments and 15 offsets.
const HEADER: usize = 64;

/// One frame's little-endian samples of `width` bytes.
///
/// # Errors
/// What is wrong with the frame, in words. Memory stays within the frame's size.
pub(crate) fn decode(frame: &[u8], pixels: usize, width: usize) -> Result<Vec<u8>, String> {
    let long = |i: usize| {
        let b = frame.get(4 * i..)?.first_chunk::<4>()?;
        Some(u32::from_le_bytes(*b) as usize)
    };
    let count = long(0).filter(|_| frame.len() >= HEADER).ok_or("its run-length header is short")?;
    if count != width {
        return Err(format!("{count} run-length segments for samples of {width} bytes"));
    }
    let mut out = vec![0; pixels * width];
    for segment in 0..width {
        let start = long(1 + segment).unwrap_or(0);
        let end = if segment + 1 < width { long(2 + segment).unwrap_or(0) } else { frame.len() };
        let coded = frame.get(start.max(HEADER)..end).ok_or("its run-length offsets are damaged")?;
        // the most significant bytes come first
        let bytes = out.iter_mut().skip(width - 1 - segment).step_by(width);
        let missing = unpacked(coded, bytes);
        if missing > 0 {
            return Err(format!("{missing} of {pixels} run-length coded pixels are missing"));
        }
    }
    Ok(out)
}

/// Runs and literals into `out`; how many were missing. What is coded beyond its end is padding.
fn unpacked<'a>(mut coded: &[u8], mut out: impl ExactSizeIterator<Item = &'a mut u8>) -> usize {
    while out.len() > 0 {
        let Some((&control, rest)) = coded.split_first() else { break };
        let literals = usize::from(control) + 1;
        match (control, rest.split_first()) {
            (0..=127, _) => {
                let taken = literals.min(rest.len());
                rest[..taken].iter().zip(&mut out).for_each(|(b, o)| *o = *b);
                coded = &rest[taken..];
            }
            (128, _) => coded = rest,
            (_, Some((&value, rest))) => {
                out.by_ref().take(257 - usize::from(control)).for_each(|o| *o = value);
                coded = rest;
            }
            (_, None) => break,
        }
    }
    out.len()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn runs_and_literals_of_the_standard() {
        let mut frame = vec![0u8; HEADER];
        frame[0] = 2;
        frame[4] = 64;
        frame[8] = 66;
        // high bytes: a run of 4 ones; low bytes: literals 1 2, a run of 2 threes
        frame.extend([253, 1, 1, 1, 2, 128, 255, 3, 0, 9]);
        assert_eq!(decode(&frame, 4, 2).unwrap(), [1, 1, 2, 1, 3, 1, 3, 1]);
        assert!(decode(&frame, 7, 2).is_err());
        assert!(decode(&frame, 4, 1).is_err());
        assert!(decode(&frame[..70], 4, 2).is_err());
    }
}
