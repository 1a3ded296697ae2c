//! How rough the function may be: the one free scale of its random field, by restricted likelihood.

use crate::Error;
use crate::constraints::Constraints;
use crate::system::{Factor, Scale};
use exec::Ctx;

/// Clusters and their size for the likelihood: 6 clusters of 250 give log s to about +-.2, which moves the surface by
/// less than a tenth of its own error.
const CLUSTERS: usize = 6;
const CLUSTER_SIZE: usize = 250;

/// The scale s of the random field (mm^2 in normalised coordinates) of largest restricted likelihood.
pub(crate) fn roughness(c: &Constraints, points: &[[f64; 3]], scale: &Scale, ctx: &Ctx) -> Result<f64, Error> {
    let clusters = clusters(points, c.wall);
    // in units of the data's size, so that another unit of length changes nothing; for vessels of 10 to 100 mm this is a
    // wall that bends with a radius of about 1 mm to 1 m
    let size2 = scale.length * scale.length;
    let candidates: Vec<f64> = (0..22).map(|k| size2 * 10f64.powf(-4.0 + 0.5 * k as f64)).collect();
    let likelihoods = candidates
        .iter()
        .map(|&s| cluster_likelihood(c, points, &clusters, s, ctx))
        .collect::<Result<Vec<f64>, Error>>()?;
    let best = (0..candidates.len()).fold(0, |b, k| if likelihoods[k] > likelihoods[b] { k } else { b });
    Ok(parabola_peak(&candidates, &likelihoods, best))
}

/// Sum of the clusters' likelihoods at scale s.
fn cluster_likelihood(
    c: &Constraints,
    points: &[[f64; 3]],
    clusters: &[Vec<usize>],
    s: f64,
    ctx: &Ctx,
) -> Result<f64, Error> {
    let mut sum = 0.0;
    for cluster in clusters {
        let p: Vec<[f64; 3]> = cluster.iter().map(|&i| points[i]).collect();
        let d: Vec<f64> = cluster.iter().map(|&i| c.sigma_mm[i].powi(2) / s).collect();
        let y: Vec<f64> = cluster.iter().map(|&i| c.values[i]).collect();
        match Factor::new(&p, &d, ctx) {
            Ok(factor) => sum += factor.log_likelihood(&y, s),
            Err(Error::Cancelled) => return Err(Error::Cancelled),
            // a cluster within one plane says nothing; a singular one rules the candidate out
            Err(Error::Coplanar { .. }) => {}
            Err(_) => return Ok(f64::NEG_INFINITY),
        }
    }
    Ok(sum)
}

/// Peak of the parabola through the best candidate and its neighbours, on the log scale.
fn parabola_peak(candidates: &[f64], values: &[f64], best: usize) -> f64 {
    if best == 0 || best + 1 == candidates.len() {
        return candidates[best];
    }
    let (a, b, c) = (values[best - 1], values[best], values[best + 1]);
    let bend = a - 2.0 * b + c;
    let shift = if bend.is_finite() && bend < 0.0 { (0.5 * (a - c) / bend).clamp(-0.5, 0.5) } else { 0.0 };
    candidates[best] * (candidates[best + 1] / candidates[best]).powf(shift)
}

/// Constraints nearest to evenly chosen wall points.
fn clusters(points: &[[f64; 3]], wall: usize) -> Vec<Vec<usize>> {
    let count = CLUSTERS.min(wall);
    (0..count)
        .map(|k| {
            let centre = points[(2 * k + 1) * wall / (2 * count)];
            let distance =
                |i: usize| (0..3).fold(0.0, |s, a| s + (points[i][a] - centre[a]) * (points[i][a] - centre[a]));
            let mut order: Vec<usize> = (0..points.len()).collect();
            order.sort_by(|&i, &j| distance(i).total_cmp(&distance(j)).then(i.cmp(&j)));
            order.truncate(CLUSTER_SIZE);
            order
        })
        .collect()
}
