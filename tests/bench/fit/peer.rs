//! The same fit by ferreus_rbf: `bench-fit-peer FILE OUT TOLERANCE NOISE`, as `bench-fit ours`.

mod data;

use data::{Data, Outcome, show_peak, write};
use faer::Mat;
use ferreus_rbf::RBFInterpolator;
use ferreus_rbf::interpolant_config::{FittingAccuracy, FittingAccuracyType, InterpolantSettings, RBFKernelType};

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [file, out, tolerance, noise] = &arguments[..] else { return Err("FILE OUT TOLERANCE NOISE".into()) };
    let data = Data::read(file)?;
    let n = data.points.len();
    let accuracy = FittingAccuracy { tolerance: tolerance.parse()?, tolerance_type: FittingAccuracyType::Absolute };
    let kernel = InterpolantSettings::builder(RBFKernelType::Cubic);
    let settings = kernel.nugget(noise.parse()?).fitting_accuracy(accuracy).build();
    let points = Mat::from_fn(n, 3, |i, a| data.points[i].to_array()[a]);
    let values = Mat::from_fn(n, 1, |i, _| data.values[i]);
    drop(data);
    let fitted = RBFInterpolator::builder(points, values, settings).build();
    let c = &fitted.coefficients.point_coefficients;
    show_peak()?;
    write(out, (0..c.nrows()).map(|i| c[(i, 0)]))
}
