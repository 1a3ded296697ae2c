//! Loops around pinholes: tunnels through a wall too thin for the lattice.
//!
//! Where two lumens all but touch (the sharp wedge between an acute graft and its host), noise of a third of a voxel
//! opens the wall here and there, and thinning, which keeps every tunnel, makes a loop around what is left of it. A loop
//! of vessels runs around something: straight lines across it pass through tissue, at least as much as the lattice can
//! show. A loop whose chords nowhere pass through more than [`PINHOLE_VOXELS`] voxels of tissue is opened at its thinner
//! side, and the report says so. Rejected: closing the volume before thinning, which also joins vessels that lie two
//! voxels apart without a word; a bound on the loop's length, which would have to be 45 voxels for the loops of the
//! survey and so drop true ones.

use crate::medial::abscissae;
use crate::{Lumen, MedialGraph};
use space::{P3, Place, Warning};

/// Tissue within a loop, along its longest chord, below which it is a pinhole, voxels. Of 60 drawn anastomoses at 128^3
/// with .35 voxel of noise 14 have such loops.
const PINHOLE_VOXELS: f64 = 3.0;
/// Chords across a loop.
const CHORDS: usize = 24;

/// A loop around a pinhole.
pub(crate) struct Pinhole {
    /// The loop's edge with the smallest radius halfway.
    pub(crate) edge: usize,
    at: P3,
    thickness_mm: f64,
}

impl Pinhole {
    pub(crate) fn warning(&self) -> Warning {
        let message = format!(
            "two lumens touch: {:.2} mm of wall between them at most, thinner than the lattice shows; the loop around it was \
             taken for a gap in the wall and opened",
            self.thickness_mm
        );
        Warning::new("skeleton.pinhole", message, Place::at(self.at))
    }
}

/// The pinhole with the thinnest edge, where there is one.
pub(crate) fn smallest(graph: &MedialGraph, lumen: &Lumen<'_>) -> Option<Pinhole> {
    if graph.cycles() == 0 {
        return None;
    }
    let radius = |e: usize| {
        let points = &graph.edges[e].points;
        lumen.inscribed(points[points.len() / 2]).unwrap_or(0.0)
    };
    let hole = |e: usize| {
        let around = way_around(graph, e)?;
        let thickness = thickness(&graph.edges[e].points, &around, lumen);
        let points = &graph.edges[e].points;
        let found = Pinhole { edge: e, at: points[points.len() / 2], thickness_mm: thickness };
        (thickness <= PINHOLE_VOXELS * lumen.spacing_mm()).then(|| (radius(e), found))
    };
    (0..graph.edges.len()).filter_map(hole).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, hole)| hole)
}

/// The shortest line from an edge's first node to its last that does not use the edge; for a self-loop the node alone.
/// `None` for an edge of no loop.
fn way_around(graph: &MedialGraph, edge: usize) -> Option<Vec<P3>> {
    let [from, to] = graph.edges[edge].nodes;
    if from == to {
        return Some(vec![graph.nodes[from].position]);
    }
    let n = graph.nodes.len();
    let (mut length, mut by, mut done) = (vec![f64::INFINITY; n], vec![None; n], vec![false; n]);
    length[from] = 0.0;
    while let Some(at) =
        (0..n).filter(|&i| !done[i] && length[i] < f64::INFINITY).min_by(|&a, &b| length[a].total_cmp(&length[b]))
    {
        done[at] = true;
        for (e, line) in graph.edges.iter().enumerate().filter(|(e, l)| *e != edge && l.nodes.contains(&at)) {
            let next = if line.nodes[0] == at { line.nodes[1] } else { line.nodes[0] };
            let reached = length[at] + line.length_mm();
            if reached < length[next] {
                (length[next], by[next]) = (reached, Some(e));
            }
        }
    }
    let mut points = Vec::new();
    let mut at = to;
    while at != from {
        let line = &graph.edges[by[at]?];
        let mut part = line.points.clone();
        if line.nodes[1] == at {
            part.reverse();
            at = line.nodes[0];
        } else {
            at = line.nodes[1];
        }
        points.extend(part);
    }
    points.reverse();
    Some(points)
}

/// The longest way through tissue along chords between two lines with the same ends, mm. A single point as the second
/// line stands for a self-loop, whose chords join its two halves.
fn thickness(line: &[P3], around: &[P3], lumen: &Lumen<'_>) -> f64 {
    let chord = |k: usize| {
        let t = k as f64 / (CHORDS + 1) as f64;
        match around {
            [_] => lumen.tissue_mm(point(line, 0.5 * t), point(line, 1.0 - 0.5 * t)),
            _ => lumen.tissue_mm(point(line, t), point(around, t)),
        }
    };
    (1..=CHORDS).map(chord).fold(0.0, f64::max)
}

/// The point at a share of a line's length.
fn point(line: &[P3], share: f64) -> P3 {
    let s = abscissae(line);
    let wanted = share * s[s.len() - 1];
    let i = s.partition_point(|&x| x < wanted).clamp(1, s.len() - 1);
    let span = (s[i] - s[i - 1]).max(f64::MIN_POSITIVE);
    line[i - 1].lerp(line[i], ((wanted - s[i - 1]) / span).clamp(0.0, 1.0))
}
