//! Raw samples of every width and byte order to grey values.

use super::Error;

/// How one sample is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sample {
    /// Unsigned, 1, 2, 4 or 8 bytes.
    Unsigned(usize),
    /// Two's complement, 1, 2, 4 or 8 bytes.
    Signed(usize),
    /// IEEE 754 single.
    Float,
    /// IEEE 754 double.
    Double,
}

/// Byte order of stored samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Order {
    /// Least significant byte first.
    Little,
    /// Most significant byte first.
    Big,
}

impl Sample {
    /// Bytes of one sample.
    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::Unsigned(n) | Self::Signed(n) => n,
            Self::Float => 4,
            Self::Double => 8,
        }
    }

    /// The value of one sample; `bytes` holds exactly [`Sample::bytes`] of them.
    fn value(self, bytes: &[u8], order: Order) -> f64 {
        let fold = |acc: u64, b: &u8| (acc << 8) | u64::from(*b);
        let bits = match order {
            Order::Big => bytes.iter().fold(0, fold),
            Order::Little => bytes.iter().rev().fold(0, fold),
        };
        match self {
            Self::Unsigned(_) => bits as f64,
            Self::Signed(n) => {
                let shift = 64 - 8 * n as u32;
                (((bits << shift) as i64) >> shift) as f64
            }
            Self::Float => f64::from(f32::from_bits(bits as u32)),
            Self::Double => f64::from_bits(bits),
        }
    }
}

/// `count` grey values slope * sample + intercept from the front of `bytes`, computed in double precision.
///
/// # Errors
/// [`Error::Truncated`] when the bytes do not suffice, [`Error::NotFinite`] for NaN or infinity (also after rescaling to
/// single precision).
pub(crate) fn grey(
    file: &str,
    bytes: &[u8],
    count: usize,
    (sample, order): (Sample, Order),
    (slope, intercept): (f64, f64),
) -> Result<Vec<f32>, Error> {
    let size = sample.bytes();
    let needed = count as u64 * size as u64;
    let Some(bytes) = usize::try_from(needed).ok().and_then(|n| bytes.get(..n)) else {
        let found = bytes.len() as u64;
        return Err(Error::Truncated { file: file.to_owned(), what: "the pixel data", needed, found });
    };
    let pixels: Vec<f32> =
        bytes.chunks_exact(size).map(|b| (slope * sample.value(b, order) + intercept) as f32).collect();
    match pixels.iter().position(|p| !p.is_finite()) {
        Some(index) => Err(Error::NotFinite { file: file.to_owned(), index }),
        None => Ok(pixels),
    }
}

/// A double from a decimal number that was stored as a single: the shortest decimal that reads back as this single, so
/// that a step of 0.7 mm is 0.7 and not 0.699999988.
pub(crate) fn decimal(x: f32) -> f64 {
    format!("{x}").parse().unwrap_or_else(|_| f64::from(x))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn signed_and_big_endian_samples_keep_their_value() {
        let plain = (1.0, 0.0);
        let read = |bytes: &[u8], n, kind| grey("x", bytes, n, kind, plain).unwrap();
        assert_eq!(read(&[0xff, 0x7f], 2, (Sample::Signed(1), Order::Little)), [-1.0, 127.0]);
        assert_eq!(read(&[0xff, 0xfe, 0x01, 0x02], 2, (Sample::Signed(2), Order::Big)), [-2.0, 258.0]);
        assert_eq!(read(&[0xfe, 0xff, 0x02, 0x01], 2, (Sample::Signed(2), Order::Little)), [-2.0, 258.0]);
        assert_eq!(read(&(-5i64).to_be_bytes(), 1, (Sample::Signed(8), Order::Big)), [-5.0]);
        assert_eq!(read(&1.5f32.to_be_bytes(), 1, (Sample::Float, Order::Big)), [1.5]);
        assert_eq!(read(&u32::MAX.to_le_bytes(), 1, (Sample::Unsigned(4), Order::Little)), [u32::MAX as f32]);
    }

    #[test]
    fn nan_is_refused_and_a_decimal_survives_single_precision() {
        let e = grey("x", &f32::NAN.to_le_bytes(), 1, (Sample::Float, Order::Little), (1.0, 0.0));
        assert!(matches!(e, Err(Error::NotFinite { index: 0, .. })));
        assert_eq!(decimal(0.7), 0.7);
        assert_eq!(decimal(-1.0e-20), -1.0e-20);
    }
}
