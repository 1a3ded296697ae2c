//! Rates of the direct sums beside the machine's own rate of square roots, in one process, by turns, on one thread.

use crate::data::{Data, Outcome};
use exec::Ctx;
use implicit::{Field, Method};
use pulp::{Arch, Simd, WithSimd};
use space::P3;
use std::hint::black_box;

const TURNS: usize = 9;
const TARGETS: usize = 2_000;
/// Numbers whose roots are taken over and over: they stay in the first cache.
const NUMBERS: usize = 1024;
const PASSES: usize = 300_000;
/// Sums at all targets per turn: the clock of CPU time may advance by 4 ms only.
const SUMS: usize = 30;

/// CPU time of this thread, s.
fn cpu() -> Outcome<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat")?;
    let ns: f64 = text.split_whitespace().next().ok_or("no schedstat")?.parse()?;
    Ok(1e-9 * ns)
}

fn rate(work: impl FnOnce() -> f64) -> Outcome<f64> {
    let start = cpu()?;
    let done = work();
    Ok(done / (cpu()? - start))
}

/// Independent roots by the widest instructions, in as many accumulators as hide the addition.
struct Roots<'a>(&'a [f64]);

impl WithSimd for Roots<'_> {
    type Output = f64;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> f64 {
        let mut sums = [simd.splat_f64s(0.0); 4];
        for x in S::as_simd_f64s(self.0).0.as_chunks::<4>().0 {
            (0..4).for_each(|k| sums[k] = simd.add_f64s(sums[k], simd.sqrt_f64s(x[k])));
        }
        sums.iter().fold(0.0, |s, x| s + simd.reduce_sum_f64s(*x))
    }
}

/// Prints the medians: roots per second, then pairs per second of f and of f with gradient, and their shares, each the
/// median of the shares in one turn.
pub(crate) fn show(data: &Data) -> Outcome<()> {
    let ctx = Ctx::new(1)?;
    let n = data.points.len();
    let noise = vec![1e-8; n];
    let (f, _) = implicit::interpolant(&data.points, (&data.values, &noise), 1e-3, Method::Iterative, &ctx)?;
    let targets: Vec<P3> = (0..TARGETS).map(|k| data.points[k * n / TARGETS] + space::V3::X * 1e-3).collect();
    let numbers: Vec<f64> = (0..NUMBERS).map(|i| 0.1 + i as f64 / NUMBERS as f64).collect();
    let pairs = (SUMS * n * TARGETS) as f64;
    let mut out = vec![0.0; TARGETS];
    let mut turns = Vec::new();
    for _ in 0..TURNS {
        let root = rate(|| {
            (0..PASSES).for_each(|_| {
                black_box(Arch::new().dispatch(Roots(black_box(&numbers))));
            });
            (PASSES * NUMBERS) as f64
        })?;
        let value = rate(|| {
            (0..SUMS).for_each(|_| {
                f.values(black_box(&targets), &mut out);
                black_box(&out);
            });
            pairs
        })?;
        let gradient = rate(|| {
            (0..SUMS).flat_map(|_| &targets).for_each(|&t| {
                black_box(f.gradient(t));
            });
            pairs
        })?;
        turns.push([root, value, gradient, value / root, gradient / root]);
    }
    let median = |k: usize| {
        let mut all: Vec<f64> = turns.iter().map(|t| t[k]).collect();
        all.sort_by(f64::total_cmp);
        all[TURNS / 2]
    };
    println!("roots {:e} value {:e} gradient {:e} shares {} {}", median(0), median(1), median(2), median(3), median(4));
    Ok(())
}
