//! JPEG-LS, lossless and near-lossless (ITU-T T.87, 1998; Weinberger, Seroussi and Sapiro 2000), one grey component.
//!
//! An own decoder, because the only maintained one is C++ and would bring cmake into every build. Colour, mapping tables
//! and restart intervals are refused: no scanner writes them for grey images. Names are those of T.87, annex A.

/// Contexts of the regular mode, then the two of run interruption.
const CONTEXTS: usize = 367;
/// Orders of the run lengths (T.87 A.2.1).
const J: [u32; 32] =
    [0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 8, 9, 10, 11, 12, 13, 14, 15];

/// A decoded frame.
pub(crate) struct Frame {
    /// Bits per sample, 2 to 16.
    pub(crate) precision: u32,
    pub(crate) samples: Vec<u16>,
}

/// Decode one frame of the size that its file states.
///
/// # Errors
/// What is wrong with the stream, in words; a stream of another size allocates nothing.
pub(crate) fn decode(stream: &[u8], columns: usize, rows: usize) -> Result<Frame, String> {
    let (header, data) = Header::parse(stream)?;
    if (header.columns, header.rows) != (columns, rows) {
        let found = format!("{} x {}", header.columns, header.rows);
        return Err(format!("a compressed frame is {found} pixels, the header states {columns} x {rows}"));
    }
    let samples = Decoder::new(&header, data).samples()?;
    Ok(Frame { precision: header.precision, samples })
}

/// What the marker segments state.
#[derive(Default)]
struct Header {
    columns: usize,
    rows: usize,
    precision: u32,
    near: i32,
    /// MAXVAL, T1, T2, T3, RESET; 0 stands for the default.
    preset: [i32; 5],
}

impl Header {
    /// The header and the entropy-coded data behind it.
    fn parse(stream: &[u8]) -> Result<(Self, &[u8]), String> {
        let mut header = Self::default();
        let mut at = 2;
        loop {
            let Some(&[0xff, marker, high, low]) = stream.get(at..).and_then(|s| s.first_chunk::<4>()) else {
                return Err("its JPEG-LS header is damaged".to_owned());
            };
            if marker == 0xff {
                at += 1; // fill byte
                continue;
            }
            let length = usize::from(u16::from_be_bytes([high, low]));
            let body = stream.get(at + 4..at + 2 + length.max(2)).ok_or("its JPEG-LS header ends too early")?;
            at += 2 + length.max(2);
            match marker {
                0xf7 => header.frame(body)?,
                0xf8 => header.preset(body)?,
                0xdd if body.iter().any(|b| *b != 0) => return Err("restart intervals are not read".to_owned()),
                0xda => {
                    header.scan(body)?;
                    return Ok((header, &stream[at..]));
                }
                _ => {}
            }
        }
    }
    fn frame(&mut self, body: &[u8]) -> Result<(), String> {
        let &[precision, y1, y0, x1, x0, components] = body.first_chunk::<6>().ok_or("its frame header is short")?;
        self.precision = u32::from(precision);
        (self.rows, self.columns) =
            (usize::from(u16::from_be_bytes([y1, y0])), usize::from(u16::from_be_bytes([x1, x0])));
        match (precision, components) {
            (2..=16, 1) => Ok(()),
            _ => Err(format!("{components} components of {precision} bits are not read")),
        }
    }
    fn preset(&mut self, body: &[u8]) -> Result<(), String> {
        match body.first_chunk::<11>() {
            Some(b) if b[0] == 1 => {
                self.preset = std::array::from_fn(|i| i32::from(u16::from_be_bytes([b[1 + 2 * i], b[2 + 2 * i]])));
                Ok(())
            }
            _ => Err("mapping tables and extended sizes are not read".to_owned()),
        }
    }
    fn scan(&mut self, body: &[u8]) -> Result<(), String> {
        match body {
            &[1, _, 0, near, _, _] => self.near = i32::from(near),
            _ => return Err("its scan header is not that of one grey component".to_owned()),
        }
        let most = self.maximum();
        if self.precision == 0 || self.near > most / 2 || most >= 1 << self.precision {
            return Err("its scan header does not fit its frame header".to_owned());
        }
        Ok(())
    }
    /// MAXVAL.
    fn maximum(&self) -> i32 {
        if self.preset[0] > 0 { self.preset[0] } else { (1 << self.precision.min(16)) - 1 }
    }
    /// T1, T2, T3 (T.87 C.2.4.1.1).
    fn thresholds(&self) -> [i32; 3] {
        let (most, near) = (self.maximum(), self.near);
        let clamp = |x: i32, least: i32| if x > most || x < least { least } else { x };
        let raw: [i32; 3] = if most >= 128 {
            let factor = (most.min(4095) + 128) / 256;
            [factor + 2 + 3 * near, 4 * factor + 3 + 5 * near, 17 * factor + 4 + 7 * near]
        } else {
            let factor = 256 / (most + 1);
            [(3 / factor + 3 * near).max(2), (7 / factor + 5 * near).max(3), (21 / factor + 7 * near).max(4)]
        };
        let mut least = near + 1;
        std::array::from_fn(|i| {
            let given = self.preset[1 + i];
            least = if given > 0 { given } else { clamp(raw[i], least) };
            least
        })
    }
}

/// Bits, most significant first; after a byte of ones the next one carries seven.
struct Bits<'a> {
    data: &'a [u8],
    at: usize,
    held: u32,
    left: u32,
    after_ones: bool,
}

impl Bits<'_> {
    fn bit(&mut self) -> Result<u32, String> {
        if self.left == 0 {
            let byte = *self.data.get(self.at).ok_or("its JPEG-LS data ends too early")?;
            if self.after_ones && byte >= 0x80 {
                return Err("its JPEG-LS data ends too early".to_owned());
            }
            self.left = if self.after_ones { 7 } else { 8 };
            self.held = u32::from(byte);
            self.after_ones = byte == 0xff;
            self.at += 1;
        }
        self.left -= 1;
        Ok(self.held >> self.left & 1)
    }
    fn bits(&mut self, count: u32) -> Result<i32, String> {
        let mut value = 0;
        for _ in 0..count {
            value = value << 1 | self.bit()? as i32;
        }
        Ok(value)
    }
}

/// One context's statistics.
#[derive(Clone, Copy)]
struct Context {
    a: i32,
    b: i32,
    c: i32,
    n: i32,
    /// Negative errors of a run interruption.
    nn: i32,
}

impl Context {
    /// Order of the Golomb code.
    fn order(&self, a: i32) -> u32 {
        (0..24).find(|&k| i64::from(self.n) << k >= i64::from(a)).unwrap_or(24)
    }
}

struct Decoder<'a> {
    bits: Bits<'a>,
    columns: usize,
    rows: usize,
    maximum: i32,
    near: i32,
    thresholds: [i32; 3],
    reset: i32,
    range: i32,
    /// Bits of an escaped error.
    qbpp: u32,
    limit: u32,
    contexts: [Context; CONTEXTS],
    run_index: usize,
}

impl<'a> Decoder<'a> {
    fn new(header: &Header, data: &'a [u8]) -> Self {
        let (maximum, near) = (header.maximum(), header.near);
        let range = (maximum + 2 * near) / (2 * near + 1) + 1;
        let bits_for = |x: i32| 32 - (x - 1).leading_zeros();
        let bpp = bits_for(maximum + 1).max(2);
        let start = Context { a: ((range + 32) / 64).max(2), b: 0, c: 0, n: 1, nn: 0 };
        Self {
            bits: Bits { data, at: 0, held: 0, left: 0, after_ones: false },
            columns: header.columns,
            rows: header.rows,
            maximum,
            near,
            thresholds: header.thresholds(),
            reset: if header.preset[4] > 0 { header.preset[4] } else { 64 },
            range,
            qbpp: bits_for(range),
            limit: 2 * (bpp + bpp.max(8)),
            contexts: [start; CONTEXTS],
            run_index: 0,
        }
    }

    fn samples(mut self) -> Result<Vec<u16>, String> {
        let w = self.columns;
        let mut out = Vec::with_capacity(w * self.rows);
        // one sample more at either side: index x + 1
        let mut above = vec![0; w + 2];
        let mut line = vec![0; w + 2];
        for _ in 0..self.rows {
            above[w + 1] = above[w];
            line[0] = above[1];
            self.line(&above, &mut line)?;
            out.extend(line[1..=w].iter().map(|&x| x as u16));
            std::mem::swap(&mut above, &mut line);
        }
        Ok(out)
    }

    fn line(&mut self, above: &[i32], line: &mut [i32]) -> Result<(), String> {
        let mut x = 1;
        while x <= self.columns {
            let (ra, rb, rc, rd) = (line[x - 1], above[x], above[x - 1], above[x + 1]);
            let gradients = [rd - rb, rb - rc, rc - ra];
            if gradients.iter().all(|d| d.abs() <= self.near) {
                x = self.run(above, line, x)?;
            } else {
                line[x] = self.regular(gradients, [ra, rb, rc])?;
                x += 1;
            }
        }
        Ok(())
    }

    fn regular(&mut self, gradients: [i32; 3], [ra, rb, rc]: [i32; 3]) -> Result<i32, String> {
        let q = gradients.iter().fold(0, |q, &d| 9 * q + self.quantised(d));
        let sign = if q < 0 { -1 } else { 1 };
        let q = q.unsigned_abs() as usize;
        let predicted = if rc >= ra.max(rb) {
            ra.min(rb)
        } else if rc <= ra.min(rb) {
            ra.max(rb)
        } else {
            ra + rb - rc
        };
        let context = self.contexts[q];
        let predicted = (predicted + sign * context.c).clamp(0, self.maximum);
        let k = context.order(context.a);
        let mapped = self.golomb(k, self.limit)?;
        let folded = self.near == 0 && k == 0 && 2 * context.b <= -context.n;
        let error = match (folded, mapped & 1) {
            (true, 1) => mapped >> 1,
            (true, _) => -(mapped >> 1) - 1,
            (false, 1) => -(mapped >> 1) - 1,
            (false, _) => mapped >> 1,
        };
        self.learn(q, error);
        Ok(self.reconstructed(predicted, sign * error))
    }

    fn quantised(&self, d: i32) -> i32 {
        let [t1, t2, t3] = self.thresholds;
        let size = d.abs();
        let step = [self.near + 1, t1, t2, t3].iter().filter(|&&t| size >= t).count() as i32;
        step * d.signum()
    }

    /// A limited-length Golomb code (T.87 A.5.3).
    fn golomb(&mut self, k: u32, limit: u32) -> Result<i32, String> {
        let escape = limit.saturating_sub(self.qbpp + 1);
        let mut zeros = 0;
        while self.bits.bit()? == 0 {
            zeros += 1;
            if zeros > escape {
                return Err("its JPEG-LS data is damaged".to_owned());
            }
        }
        if zeros == escape {
            return Ok(self.bits.bits(self.qbpp)? + 1);
        }
        let low = self.bits.bits(k)?;
        // true errors stay within the range
        i32::try_from(i64::from(zeros) << k | i64::from(low))
            .ok()
            .filter(|m| *m <= self.range + 1)
            .ok_or_else(|| "its JPEG-LS data is damaged".to_owned())
    }

    fn learn(&mut self, q: usize, error: i32) {
        let c = &mut self.contexts[q];
        c.b += error * (2 * self.near + 1);
        c.a = c.a.saturating_add(error.abs());
        if c.n == self.reset {
            (c.a, c.b, c.n) = (c.a >> 1, c.b >> 1, c.n >> 1);
        }
        c.n += 1;
        if c.b <= -c.n {
            c.b = (c.b + c.n).max(1 - c.n);
            c.c = (c.c - 1).max(-128);
        } else if c.b > 0 {
            c.b = (c.b - c.n).min(0);
            c.c = (c.c + 1).min(127);
        }
    }

    fn reconstructed(&self, predicted: i32, error: i32) -> i32 {
        let step = 2 * self.near + 1;
        let value = predicted + error * step;
        let wrapped = if value < -self.near {
            value + self.range * step
        } else if value > self.maximum + self.near {
            value - self.range * step
        } else {
            value
        };
        wrapped.clamp(0, self.maximum)
    }

    /// A run of the sample on the left and what interrupts it; the next position.
    fn run(&mut self, above: &[i32], line: &mut [i32], start: usize) -> Result<usize, String> {
        let value = line[start - 1];
        let mut x = start;
        while self.bits.bit()? == 1 {
            let whole = 1 << J[self.run_index];
            let filled = whole.min(self.columns + 1 - x);
            line[x..x + filled].fill(value);
            x += filled;
            if filled == whole {
                self.run_index = (self.run_index + 1).min(31);
            }
            if x > self.columns {
                return Ok(x);
            }
        }
        let rest = self.bits.bits(J[self.run_index])? as usize;
        if x + rest > self.columns {
            return Err("its JPEG-LS data is damaged".to_owned());
        }
        line[x..x + rest].fill(value);
        x += rest;
        line[x] = self.interruption(value, above[x])?;
        self.run_index = self.run_index.saturating_sub(1);
        Ok(x + 1)
    }

    fn interruption(&mut self, ra: i32, rb: i32) -> Result<i32, String> {
        let alike = (ra - rb).abs() <= self.near;
        let kind = i32::from(alike);
        let q = 365 + kind as usize;
        let context = self.contexts[q];
        let k = context.order(context.a + if alike { context.n >> 1 } else { 0 });
        let mapped = self.golomb(k, self.limit - J[self.run_index] - 1)?;
        let folded = mapped + kind;
        let size = (folded + 1) >> 1;
        let negative = (k != 0 || 2 * context.nn >= context.n) == (folded & 1 == 1);
        let error = if negative { -size } else { size };
        let c = &mut self.contexts[q];
        c.nn += i32::from(error < 0);
        c.a = c.a.saturating_add((mapped + 1 - kind) >> 1);
        if c.n == self.reset {
            (c.a, c.n, c.nn) = (c.a >> 1, c.n >> 1, c.nn >> 1);
        }
        c.n += 1;
        let (predicted, sign) = if alike { (ra, 1) } else { (rb, if ra > rb { -1 } else { 1 }) };
        Ok(self.reconstructed(predicted, sign * error))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// The example of T.87, annex H.3.
    #[test]
    fn the_standards_own_example_is_decoded() {
        let stream = [
            0xff, 0xd8, 0xff, 0xf7, 0, 11, 8, 0, 4, 0, 4, 1, 1, 0x11, 0, 0xff, 0xda, 0, 8, 1, 1, 0, 0, 0, 0, 0xc0, 0,
            0, 0x6c, 0x80, 0x20, 0x8e, 0x01, 0xc0, 0, 0, 0x57, 0x40, 0, 0, 0x6e, 0xe6, 0, 0, 0x01, 0xbc, 0x18, 0, 0,
            0x05, 0xd8, 0, 0, 0x91, 0x60, 0xff, 0xd9,
        ];
        let frame = decode(&stream, 4, 4).unwrap();
        assert_eq!(frame.samples, [0, 0, 90, 74, 68, 50, 43, 205, 64, 145, 145, 145, 100, 145, 145, 145]);
        assert_eq!(frame.precision, 8);
        assert!(decode(&stream, 4, 5).is_err());
        for end in 0..stream.len() - 3 {
            assert!(decode(&stream[..end], 4, 4).is_err(), "{end}");
        }
    }
}
