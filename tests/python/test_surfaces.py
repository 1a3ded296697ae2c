"""Judges meshes of the surface's survey by a program that is not ours: pymeshlab.

    cargo run --release -p surface --example survey -- 20 0 FOLDER
    SURFACES=FOLDER python -m pytest tests/python/test_surfaces.py     (or: python tests/python/test_surfaces.py)

Every .off file in the folder must be a closed 2-manifold without faces that pass through each other.
"""

import os
import pathlib

import pymeshlab

FILES = sorted(pathlib.Path(os.environ["SURFACES"]).glob("*.off"))


def faults(path):
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(path))
    measures = meshes.get_topological_measures()
    meshes.compute_selection_by_self_intersections_per_face()
    return {
        "boundary edges": measures["boundary_edges"],
        "non-manifold edges": measures["non_two_manifold_edges"],
        "non-manifold vertices": measures["non_two_manifold_vertices"],
        "self-intersecting faces": meshes.current_mesh().selected_face_number(),
    }


def test_surfaces():
    assert FILES, "no .off file in SURFACES"
    bad = {path.name: f for path in FILES if any((f := faults(path)).values())}
    assert not bad, bad


if __name__ == "__main__":
    test_surfaces()
    print(f"{len(FILES)} surfaces are closed, 2-manifold and free of self-intersections")
