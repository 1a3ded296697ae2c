"""Reads the artefacts of one reconstruction with VTK and checks the contract's arrays.

    VASCULUM_OUT=FOLDER python -m pytest tests/python/test_artefacts.py     (or: python tests/python/test_artefacts.py)

Needs vtk, numpy and networkx.
"""

import csv
import json
import math
import os
import pathlib
import struct

import networkx as nx
import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkFiltersCore import vtkFeatureEdges, vtkMassProperties
from vtkmodules.vtkIOGeometry import vtkSTLReader
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

OUT = pathlib.Path(os.environ["VASCULUM_OUT"])


def read(name):
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(OUT / name))
    reader.Update()
    assert reader.GetErrorCode() == 0, name
    return reader.GetOutput()


def arrays(data):
    return {data.GetArrayName(i): vtk_to_numpy(data.GetArray(i)) for i in range(data.GetNumberOfArrays())}


def result():
    return json.loads((OUT / "result.json").read_text())


def test_surface_has_the_arrays_and_the_figures_of_result_json():
    surface, expected = read("surface.vtp"), result()["surface"]
    assert surface.GetNumberOfPoints() == expected["vertices"]
    assert surface.GetNumberOfPolys() == expected["triangles"]
    points, cells = arrays(surface.GetPointData()), arrays(surface.GetCellData())
    assert {"Normals", "Displacement_mm", "Displacement_px"} <= points.keys()
    assert "FaceId" in cells and cells["FaceId"].min() == 0
    if expected["patches"] is not None:
        assert {"U", "V"} <= points.keys() and "PatchId" in cells
    assert surface.GetPointData().GetNormals() is not None
    assert np.allclose(np.linalg.norm(points["Normals"], axis=1), 1.0)
    mass = vtkMassProperties()
    mass.SetInputData(surface)
    mass.Update()
    assert math.isclose(mass.GetSurfaceArea(), expected["area_mm2"], rel_tol=1e-5)
    assert math.isclose(mass.GetVolume(), expected["volume_mm3"], rel_tol=1e-3)


def test_patches_are_numbered_by_the_ends_of_their_branches():
    """The portal colours the wall by it: a patch N - 1 lies around the branch that ends at cap N."""
    surface, expected = read("surface.vtp"), result()
    points, cells = vtk_to_numpy(surface.GetPoints().GetData()), arrays(surface.GetCellData())
    if expected["surface"]["patches"] is None:
        return
    corners = vtk_to_numpy(surface.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    lines = {b["id"]: np.array(b["samples"]["position"], float) for b in expected["branches"]}
    wall = cells["FaceId"] == 0
    ends = [node for node in expected["graph"]["nodes"] if node["cap"] is not None]
    assert ends
    for node in ends:
        mine = next(e["branch"] for e in expected["graph"]["edges"] if node["id"] in e["nodes"])
        centres = points[corners[wall & (cells["PatchId"] == node["cap"] - 1)]].mean(axis=1)[::50]
        near = {b: np.linalg.norm(centres[:, None] - line[None], axis=2).min(axis=1).mean() for b, line in lines.items()}
        assert min(near, key=near.get) == mine, (node, near)


def test_a_surface_said_to_be_watertight_is_watertight():
    if not result()["surface"]["watertight"]:
        return
    edges = vtkFeatureEdges()
    edges.SetInputData(read("surface.vtp"))
    edges.BoundaryEdgesOn()
    edges.NonManifoldEdgesOn()
    edges.FeatureEdgesOff()
    edges.ManifoldEdgesOff()
    edges.Update()
    assert edges.GetOutput().GetNumberOfCells() == 0


def test_skeleton_has_vmtk_s_arrays():
    skeleton, expected = read("skeleton.vtp"), result()
    points, cells = arrays(skeleton.GetPointData()), arrays(skeleton.GetCellData())
    assert {"MaximumInscribedSphereRadius", "Abscissas", "Curvature"} <= points.keys()
    assert {"GroupIds", "CenterlineIds", "TractIds", "Blanking"} <= cells.keys()
    assert set(cells["CenterlineIds"]) == {e["id"] for e in expected["graph"]["edges"]}
    assert set(np.unique(cells["Blanking"])) <= {0, 1}
    assert np.all(points["MaximumInscribedSphereRadius"] >= 0)
    if any(b["helix"] for b in expected["branches"]):
        assert "Torsion" in points
    for edge in expected["graph"]["edges"]:
        lines = [i for i in range(skeleton.GetNumberOfCells()) if cells["CenterlineIds"][i] == edge["id"]]
        last = skeleton.GetCell(lines[-1]).GetPointIds()
        end = points["Abscissas"][last.GetId(last.GetNumberOfIds() - 1)]
        assert math.isclose(end, edge["length_mm"], rel_tol=1e-6)


def test_skeleton_json_and_graphml_are_the_graph_of_result_json():
    expected = result()["graph"]
    node_link = nx.node_link_graph(json.loads((OUT / "skeleton.json").read_text()), edges="links")
    graphs = [node_link]
    if (OUT / "skeleton.graphml").exists():
        graphs.append(nx.read_graphml(OUT / "skeleton.graphml", force_multigraph=True))
    for graph in graphs:
        assert graph.number_of_nodes() == len(expected["nodes"])
        assert graph.number_of_edges() == len(expected["edges"])
        cycles = graph.number_of_edges() - graph.number_of_nodes() + nx.number_connected_components(graph)
        assert cycles == expected["cycles"]
        lengths = sorted(data["length_mm"] for _, _, data in graph.edges(data=True))
        assert np.allclose(lengths, sorted(e["length_mm"] for e in expected["edges"]))


def test_swc_is_a_tree_of_the_same_length():
    if not (OUT / "skeleton.swc").exists():
        return
    rows = np.loadtxt(OUT / "skeleton.swc")
    parents = rows[:, 6].astype(int)
    assert np.all(parents < rows[:, 0]) and parents[0] == -1
    linked = parents > 0
    steps = np.linalg.norm(rows[linked, 2:5] - rows[parents[linked] - 1, 2:5], axis=1)
    assert math.isclose(steps.sum(), sum(e["length_mm"] for e in result()["graph"]["edges"]), rel_tol=1e-5)


def test_contours_are_closed():
    contours = read("contours.vtp")
    cells = arrays(contours.GetCellData())
    assert {"Plane", "Lumen", "Level", "StandardError_mm"} <= cells.keys()
    assert "OnBorder" in arrays(contours.GetPointData())
    for i in range(contours.GetNumberOfCells()):
        ids = contours.GetCell(i).GetPointIds()
        assert ids.GetId(0) == ids.GetId(ids.GetNumberOfIds() - 1)


def test_stl_is_the_same_surface():
    reader = vtkSTLReader()
    reader.SetFileName(str(OUT / "surface.stl"))
    reader.MergingOff()  # merging drops triangles that single precision made degenerate
    reader.Update()
    assert reader.GetOutput().GetNumberOfPolys() == result()["surface"]["triangles"]
    mass = vtkMassProperties()
    mass.SetInputData(reader.GetOutput())
    mass.Update()
    assert math.isclose(mass.GetSurfaceArea(), result()["surface"]["area_mm2"], rel_tol=1e-5)


def test_glb_is_the_surface_in_metres_with_the_head_up():
    data = (OUT / "surface.glb").read_bytes()
    magic, version, length = struct.unpack("<4sII", data[:12])
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size = struct.unpack("<I", data[12:16])[0]
    document = json.loads(data[20 : 20 + size])
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for primitive in document["meshes"][0]["primitives"]:
        accessor = document["accessors"][primitive["attributes"]["POSITION"]]
        low, high = np.minimum(low, accessor["min"]), np.maximum(high, accessor["max"])
    x0, x1, y0, y1, z0, z1 = read("surface.vtp").GetBounds()
    assert np.allclose(low * 1000, [x0, z0, -y1], atol=1e-4)
    assert np.allclose(high * 1000, [x1, z1, -y0], atol=1e-4)


def test_angles_csv_says_what_result_json_says():
    with open(OUT / "angles.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["kind"] == "value"]
    angles = [(j["node"], a) for j in result()["junctions"] for a in j["angles"]]
    assert len(rows) == len(angles)
    for row, (node, angle) in zip(rows, angles):
        assert (int(row["junction"]), row["angle"]) == (node, angle["name"])
        assert (float(row["value_deg"]) if row["value_deg"] else None) == angle["value"]


if __name__ == "__main__":
    for name, test in sorted(globals().items()):
        if name.startswith("test_"):
            test()
            print("ok", name)
