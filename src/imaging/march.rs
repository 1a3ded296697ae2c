//! Marching squares: the zero lines of a function sampled on a rectangular lattice in the plane.
//!
//! Linear interpolation along lattice edges; an ambiguous cell is decided by the sign at its bilinear saddle point
//! (Nielson and Hamann's asymptotic decider). The lattice is given a rim of negative samples that coincide with its
//! border, so that every line is closed: where the positive region reaches the border the line follows it.

/// A closed zero line.
#[derive(Clone, Debug)]
pub(crate) struct Line {
    /// Points in order, the positive side on the left.
    pub(crate) points: Vec<[f64; 2]>,
    /// Whether a point lies on the lattice border because the line was closed there.
    pub(crate) border: Vec<bool>,
}

impl Line {
    /// Enclosed area, positive for a counterclockwise line.
    pub(crate) fn area(&self) -> f64 {
        let n = self.points.len();
        (0..n).fold(0.0, |a, i| {
            let (p, q) = (self.points[i], self.points[(i + 1) % n]);
            a + 0.5 * (p[0] * q[1] - p[1] * q[0])
        })
    }
}

/// A function on a rectangular lattice: values[j * xs.len() + i] at (xs[i], ys[j]).
pub(crate) struct Lattice<'a> {
    pub(crate) xs: &'a [f64],
    pub(crate) ys: &'a [f64],
    pub(crate) values: &'a [f32],
}

/// The lattice with its rim.
struct Rimmed {
    xs: Vec<f64>,
    ys: Vec<f64>,
    values: Vec<f64>,
}

const NONE: u32 = u32::MAX;

/// All zero lines, in the order of their first lattice edge.
pub(crate) fn zero_lines(lattice: &Lattice) -> Vec<Line> {
    let g = rimmed(lattice);
    let (w, h) = (g.xs.len(), g.ys.len());
    let mut next = vec![NONE; 2 * w * h];
    for j in 0..h - 1 {
        for i in 0..w - 1 {
            link(&g, i, j, &mut next);
        }
    }
    let mut lines = Vec::new();
    for start in 0..next.len() {
        if next[start] == NONE {
            continue;
        }
        let mut line = Line { points: Vec::new(), border: Vec::new() };
        let mut edge = start;
        while next[edge] != NONE {
            let (point, rim) = crossing(&g, edge);
            line.points.push(point);
            line.border.push(rim);
            edge = std::mem::replace(&mut next[edge], NONE) as usize;
        }
        lines.push(line);
    }
    lines
}

fn rimmed(l: &Lattice) -> Rimmed {
    let ring = |a: &[f64]| {
        let mut v = Vec::with_capacity(a.len() + 2);
        v.extend(a.first());
        v.extend_from_slice(a);
        v.extend(a.last());
        v
    };
    let (w, h) = (l.xs.len(), l.ys.len());
    let mut values = vec![-1.0; (w + 2) * (h + 2)];
    for j in 0..h {
        for i in 0..w {
            values[(j + 1) * (w + 2) + i + 1] = f64::from(l.values[j * w + i]);
        }
    }
    Rimmed { xs: ring(l.xs), ys: ring(l.ys), values }
}

/// Enters the segments of cell (i, j) into the list of successors: from the edge where a counterclockwise walk round
/// the cell leaves the positive side to the one where it comes back.
fn link(g: &Rimmed, i: usize, j: usize, next: &mut [u32]) {
    let (w, h) = (g.xs.len(), g.ys.len());
    let at = |i: usize, j: usize| g.values[j * w + i];
    let d = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
    let inside = d.map(|x| x > 0.0);
    let edges = [j * w + i, w * h + j * w + i + 1, (j + 1) * w + i, w * h + j * w + i];
    let leaves = |e: usize| inside[e] && !inside[(e + 1) % 4];
    let enters = |e: usize| !inside[e] && inside[(e + 1) % 4];
    let saddle = (0..4).filter(|&e| leaves(e)).count() == 2;
    let joined = saddle && {
        let (a, b) = (d[0] * d[2] - d[1] * d[3], d[0] + d[2] - d[1] - d[3]);
        a / b > 0.0
    };
    for from in (0..4).filter(|&e| leaves(e)) {
        // Joined lobes: the segment cuts off the negative corner that follows; else it closes round the positive one.
        let to = if saddle && !joined {
            (from + 3) % 4
        } else {
            (1..4).map(|k| (from + k) % 4).find(|&e| enters(e)).unwrap_or(from)
        };
        next[edges[from]] = edges[to] as u32;
    }
}

fn crossing(g: &Rimmed, edge: usize) -> ([f64; 2], bool) {
    let (w, h) = (g.xs.len(), g.ys.len());
    let vertical = edge >= w * h;
    let e = edge % (w * h);
    let (i, j) = (e % w, e / w);
    let (i2, j2) = if vertical { (i, j + 1) } else { (i + 1, j) };
    let (a, b) = (g.values[j * w + i], g.values[j2 * w + i2]);
    let t = (a / (a - b)).clamp(0.0, 1.0);
    let mix = |p: f64, q: f64| p + (q - p) * t;
    let rim = i == 0 || j == 0 || i2 == w - 1 || j2 == h - 1;
    ([mix(g.xs[i], g.xs[i2]), mix(g.ys[j], g.ys[j2])], rim)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn lattice(n: usize, f: impl Fn(f64, f64) -> f64) -> (Vec<f64>, Vec<f32>) {
        let xs: Vec<f64> = (0..n).map(|i| i as f64).collect();
        let v = (0..n * n).map(|k| f((k % n) as f64, (k / n) as f64) as f32).collect();
        (xs, v)
    }
    fn lines(xs: &[f64], values: &[f32]) -> Vec<Line> {
        zero_lines(&Lattice { xs, ys: xs, values })
    }

    #[test]
    fn a_disc_gives_one_counterclockwise_line_of_its_area() {
        let (xs, v) = lattice(30, |x, y| 8.0 - (x - 14.3).hypot(y - 15.1));
        let l = lines(&xs, &v);
        assert_eq!(l.len(), 1);
        assert!((l[0].area() / (64.0 * std::f64::consts::PI) - 1.0).abs() < 5e-3, "{}", l[0].area());
        assert!(l[0].border.iter().all(|b| !b));
    }

    #[test]
    fn a_ring_gives_a_clockwise_hole() {
        let (xs, v) = lattice(40, |x, y| 3.0 - ((x - 20.0).hypot(y - 20.0) - 10.0).abs());
        let mut areas: Vec<f64> = lines(&xs, &v).iter().map(Line::area).collect();
        areas.sort_by(f64::total_cmp);
        assert_eq!(areas.len(), 2);
        assert!(areas[0] < -140.0 && areas[1] > 510.0, "{areas:?}");
    }

    #[test]
    fn a_disc_on_the_border_is_closed_along_it() {
        let (xs, v) = lattice(30, |x, y| 6.0 - x.hypot(y - 15.0));
        let l = lines(&xs, &v);
        assert_eq!(l.len(), 1);
        assert!((l[0].area() / (18.0 * std::f64::consts::PI) - 1.0).abs() < 0.01);
        let on: Vec<[f64; 2]> = l[0].points.iter().zip(&l[0].border).filter(|(_, b)| **b).map(|(p, _)| *p).collect();
        assert!(on.len() >= 10 && on.iter().all(|p| p[0] == 0.0));
    }

    #[test]
    fn the_saddle_decides_ambiguous_cells() {
        // two discs whose bridge is decided by the saddle's sign: x y = c near the centre
        for (c, count) in [(-0.1, 1), (0.1, 2)] {
            let xs = [-3.0, -0.5, 0.5, 3.0];
            let mut v = vec![-1.0f32; 16];
            for (j, y) in xs.iter().enumerate() {
                for (i, x) in xs.iter().enumerate() {
                    if (1..3).contains(&i) && (1..3).contains(&j) {
                        v[j * 4 + i] = (x * y - c) as f32;
                    }
                }
            }
            assert_eq!(lines(&xs, &v).len(), count, "{c}");
        }
    }
}
