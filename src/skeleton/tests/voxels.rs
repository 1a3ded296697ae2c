//! The sparse voxelisation against every voxel of the box, and the limits of the check.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod shapes;

use exec::Ctx;
use implicit::Field;
use shapes::*;
use skeleton::{BitVolume, Edge, Error, MedialGraph, Node, NodeKind, Settings, check, voxelise};
use space::{P3, V3};

#[test]
fn the_sparse_voxels_are_those_of_f_at_every_voxel() {
    for h in [0.9, 0.47] {
        let star = star(
            P3::new(0.3, 0.2, 0.1),
            &[(V3::Z, 15.0, 3.0), (-V3::Z, 15.0, 2.5), (V3::new(1.0, 0.2, 0.8), 14.0, 2.0)],
        );
        let settings = Settings { spacing_mm: Some(h), ..Settings::default() };
        let (sparse, grid) = voxelise(&star.vessel, &star.cuts, &star.seeds, &settings, &Ctx::new(2).unwrap()).unwrap();
        let mut every = BitVolume::new(grid.size);
        for k in 0..grid.size[2] {
            for j in 0..grid.size[1] {
                for i in 0..grid.size[0] {
                    let x = grid.point(i, j, k);
                    let data = star.cuts.iter().all(|c| (x - c.point).dot(c.outward) <= 0.0);
                    if data && star.vessel.bounds().contains(x) && star.vessel.value(x) > 0.0 {
                        every.set([i, j, k]);
                    }
                }
            }
        }
        assert!(sparse == every, "h {h}: {} voxels, not {}", sparse.count(), every.count());
    }
}

#[test]
fn the_automatic_spacing_is_a_quarter_of_the_smallest_radius() {
    let star = star(P3::ORIGIN, &[(V3::Z, 25.0, 3.0), (-V3::Z, 25.0, 3.0), (V3::X, 25.0, 2.0)]);
    let (_, grid) =
        voxelise(&star.vessel, &star.cuts, &star.seeds, &Settings::default(), &Ctx::new(2).unwrap()).unwrap();
    let h = (grid.point(1, 0, 0) - grid.point(0, 0, 0)).length();
    assert!((0.4..0.6).contains(&h), "{h}");
}

fn straight() -> (Vessel, MedialGraph) {
    let points: Vec<P3> = (0..=8).map(|i| P3::new(0.0, 0.0, f64::from(i))).collect();
    let end = |position| Node { kind: NodeKind::End, position, radius_mm: 2.0, cap: None };
    let nodes = vec![end(points[0]), end(points[8])];
    let edges = vec![Edge { nodes: [0, 1], radius_mm: vec![2.0; 9], points }];
    let vessel = Vessel::new(&[(P3::ORIGIN, P3::new(0.0, 0.0, 8.0), 2.0)]);
    (vessel, MedialGraph { nodes, edges })
}

#[test]
fn the_check_names_the_first_offence() {
    let (vessel, good) = straight();
    assert_eq!(check(&good, &vessel, &[]), Ok(()));
    let broken = |change: fn(&mut MedialGraph)| {
        let mut g = good.clone();
        change(&mut g);
        check(&g, &vessel, &[]).unwrap_err()
    };
    assert!(matches!(broken(|g| g.nodes[1].kind = NodeKind::Junction), Error::Degree { node: 1, degree: 1, .. }));
    assert!(matches!(broken(|g| g.edges[0].points[4] = g.edges[0].points[3]), Error::Abscissa { point: 4, .. }));
    assert!(matches!(broken(|g| g.edges[0].points[4] = P3::new(3.0, 0.0, 4.0)), Error::Outside { edge: 0, .. }));
    assert!(matches!(broken(|g| g.edges[0].radius_mm[2] = f64::NAN), Error::Radius { edge: 0, .. }));
    assert!(matches!(broken(|g| g.edges[0].points[0] = P3::new(0.1, 0.0, 0.0)), Error::Line { edge: 0, .. }));
    assert!(matches!(broken(|g| g.edges[0].nodes[1] = 7), Error::Line { edge: 0, .. }));
}
