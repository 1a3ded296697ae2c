"""Judges meshes of the surface's survey by a program that is not ours: pymeshlab.

    cargo run --release -p surface --example survey -- 20 0 FOLDER
    SURFACES=FOLDER python -m pytest tests/python/test_surfaces.py     (or: python tests/python/test_surfaces.py)

Every .off file in the folder must be a closed 2-manifold of the right genus without faces that pass through each other, and
without angles below 33 degrees (30 where sizes follow the curvature) or above 120.
"""

import os
import pathlib

import numpy as np
import pymeshlab

FILES = sorted(pathlib.Path(os.environ["SURFACES"]).glob("*.off"))


def genus(path):
    """Every fourth vessel of the survey is a torus; the rest, and the benchmark, have no handle."""
    number = path.name.split("-")[0]
    return int(number.isdigit() and int(number) % 4 == 0)


def odd_angles(path, mesh):
    p = mesh.vertex_matrix()[mesh.face_matrix()]
    edges = [p[:, (k + 1) % 3] - p[:, k] for k in range(3)]
    unit = [e / np.linalg.norm(e, axis=1)[:, None] for e in edges]
    angles = np.degrees(np.arccos(np.clip([-(unit[k] * unit[k - 1]).sum(1) for k in range(3)], -1, 1)))
    least = 30 if "adaptive" in path.name else 33
    return int((angles < least).sum() + (angles > 120).sum())


def faults(path):
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(path))
    measures = meshes.get_topological_measures()
    meshes.compute_selection_by_self_intersections_per_face()
    return {
        "boundary edges": measures["boundary_edges"],
        "non-manifold edges": measures["non_two_manifold_edges"],
        "non-manifold vertices": measures["non_two_manifold_vertices"],
        "wrong genus": measures["genus"] - genus(path),
        "odd angles": odd_angles(path, meshes.current_mesh()),
        "self-intersecting faces": meshes.current_mesh().selected_face_number(),
    }


def test_surfaces():
    assert FILES, "no .off file in SURFACES"
    bad = {path.name: f for path in FILES if any((f := faults(path)).values())}
    assert not bad, bad


if __name__ == "__main__":
    test_surfaces()
    print(f"{len(FILES)} surfaces are closed, 2-manifold, of the right genus, with wide angles and free of self-intersections")
