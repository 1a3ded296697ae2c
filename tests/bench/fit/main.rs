//! One fit, or one measurement, per process: what `tests/bench/fit.py` runs and times.
//!
//! ```text
//! make N FILE                       constraints of the benchmark anastomosis
//! idle FILE                         read them, start the threads, end: the baseline of time and memory
//! ours FILE OUT TOLERANCE NOISE     conjugate gradients of src/implicit; coefficients to OUT
//! dense FILE OUT TOLERANCE NOISE    its dense factor
//! residual FILE OUT NOISE           largest true residual of coefficients, by a plain double sum
//! rates FILE                        pairs per second of f and of f with gradient, square roots per second
//! ```

mod constraints;
mod data;
mod rates;
mod residual;

use data::{Data, Outcome, numbers, show_peak, write};
use exec::Ctx;
use implicit::Method;

fn fit(file: &str, [tolerance, noise]: [&str; 2], method: Method) -> Outcome<Vec<f64>> {
    let data = Data::read(file)?;
    let ctx = Ctx::new(0)?;
    let noise = vec![noise.parse()?; data.points.len()];
    let (_, report) = implicit::interpolant(&data.points, (&data.values, &noise), tolerance.parse()?, method, &ctx)?;
    println!("iterations {}", report.iterations);
    show_peak()?;
    Ok(report.coefficients)
}

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words[..] {
        ["make", n, file] => write(file, constraints::of(n.parse()?)),
        ["idle", file] => {
            let data = Data::read(file)?;
            let ctx = Ctx::new(0)?;
            println!("{} constraints, {} threads", data.points.len(), ctx.map_range(64, |_| ctx.threads())?[0]);
            show_peak()
        }
        ["ours", file, out, tolerance, noise] => write(out, fit(file, [tolerance, noise], Method::Iterative)?),
        ["dense", file, out, tolerance, noise] => write(out, fit(file, [tolerance, noise], Method::Dense)?),
        ["residual", file, out, noise] => {
            let [largest, side] = residual::of(&Data::read(file)?, &numbers(out)?, noise.parse()?)?;
            println!("residual {largest:e} side {side:e}");
            Ok(())
        }
        ["rates", file] => rates::show(&Data::read(file)?),
        _ => Err("see the head of tests/bench/fit/main.rs".into()),
    }
}
