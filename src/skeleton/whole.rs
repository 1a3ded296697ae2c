//! All steps from f to the checked medial graph.

use crate::cluster::merge_clusters;
use crate::voxelise::spacing;
use crate::{
    CapHint, Error, Lumen, MedialGraph, NodeKind, Settings, check, extend_to_caps, graph, prune, recentre, thin,
    voxelise,
};
use exec::Ctx;
use imaging::CutPlane;
use implicit::Field;
use space::{P3, Place, Warning};

/// What was done on the way to the medial graph.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Lumen voxels before thinning.
    pub voxels: usize,
    /// Lattice size.
    pub size: [usize; 3],
    /// Spacing of the lattice, mm.
    pub spacing_mm: f64,
    /// Thinning subiterations.
    pub subiterations: usize,
    /// Spurs dropped.
    pub spurs: usize,
    /// What the reader of the result must know: `skeleton.coarse`, `skeleton.compact_piece`, `skeleton.pinhole`,
    /// `skeleton.stub`, `skeleton.end_without_cap`.
    pub warnings: Vec<Warning>,
}

/// The medial graph of the lumen f > 0 within `cuts`: voxelised, thinned (Palágyi and Kuba 1998), traced, spurs pruned,
/// ends extended to `caps`, recentred on f, checked.
///
/// `cuts` are the planes at which the data end, `caps` the surface's caps, one for each place where a vessel leaves the
/// data. `seeds` are points in the lumen or within two voxels of its wall, at least one for each piece of it; only pieces
/// that they lead to are kept. Points are LPS mm. The same graph to the bit for
/// any number of threads. Under rotation of the input by 90 degrees the graph is the same but for numbering and some
/// .02 voxel, since the order of the thinning directions is fixed.
///
/// # Errors
/// Those of [`voxelise`], [`thin`], [`prune`] and [`check`].
pub fn medial_graph(
    field: &dyn Field,
    cuts: &[CutPlane],
    caps: &[CapHint],
    seeds: &[P3],
    settings: &Settings,
    ctx: &Ctx,
) -> Result<(MedialGraph, Report), Error> {
    settings.check()?;
    let (h, coarse) = spacing(field, seeds, settings, ctx)?;
    let settings = Settings { spacing_mm: Some(h), ..settings.clone() };
    let (volume, grid) = voxelise(field, cuts, seeds, &settings, &ctx.part(0.0, 0.4))?;
    let mut thinned = volume.clone();
    let thinning = thin(&mut thinned, &ctx.part(0.4, 0.5))?;
    let Some(lumen) = Lumen::new(field, cuts, &volume, &grid) else {
        return Err(Error::Setting { name: "spacing_mm", value: h, range: "positive and finite" });
    };
    let (mut graph, pruning) = prune(graph(&thinned, &grid), &lumen, caps, &settings, ctx)?;
    let stubs = extend_to_caps(&mut graph, &lumen, caps);
    recentre(&mut graph, &lumen, &settings, &ctx.part(0.5, 0.9))?;
    // the junctions of a trifurcation only come together where their axes cross
    let junctions = graph.nodes.len();
    let mut graph = merge_clusters(graph);
    if graph.nodes.len() < junctions {
        recentre(&mut graph, &lumen, &settings, &ctx.part(0.9, 1.0))?;
    }
    check(&graph, field, caps)?;
    let warnings = coarse.into_iter().chain(pruning.warnings).chain(stubs).chain(ends_without_cap(&graph)).collect();
    let report = Report {
        voxels: volume.count(),
        size: volume.size(),
        spacing_mm: h,
        subiterations: thinning.subiterations,
        spurs: pruning.spurs,
        warnings,
    };
    Ok((graph, report))
}

fn ends_without_cap(graph: &MedialGraph) -> Vec<Warning> {
    let free = graph.nodes.iter().enumerate().filter(|(_, n)| n.kind == NodeKind::End && n.cap.is_none());
    free.map(|(i, node)| {
        let message =
            format!("branch end {i} (inscribed radius {:.2} mm) reaches no cap of the surface", node.radius_mm);
        let place = Place { element: Some(i), ..Place::at(node.position) };
        Warning::new("skeleton.end_without_cap", message, place)
    })
    .collect()
}
