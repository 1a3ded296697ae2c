"""docs/solver/mesh.py, as the tutorial runs it: the tetrahedra fill exactly what the surface with its flow extensions encloses, its
triangles are the boundary, patch by patch, and every end of result.json has its patch."""

import json
import os
import pathlib
import subprocess
import sys
import tempfile

import meshio
import numpy
from vtk import vtkXMLPolyDataReader
from vtk.util.numpy_support import vtk_to_numpy

root, out = pathlib.Path(os.environ["VASCULUM_ROOT"]), pathlib.Path(os.environ["VASCULUM_OUT"])


def areas(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return numpy.linalg.norm(numpy.cross(b - a, c - a), axis=1) / 2


def main():
    source = out / "surface_extended.vtp"
    with tempfile.TemporaryDirectory() as folder:
        target = pathlib.Path(folder) / "vessel.msh"
        said = subprocess.run([sys.executable, str(root / "docs/solver/mesh.py"), str(source), str(target)], check=True, capture_output=True, text=True, timeout=120).stdout
        mesh = meshio.read(target)
    reader = vtkXMLPolyDataReader()
    reader.SetFileName(str(source))
    reader.Update()
    surface = reader.GetOutput()
    points = vtk_to_numpy(surface.GetPoints().GetData()) / 1000
    triangles = vtk_to_numpy(surface.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    faces = vtk_to_numpy(surface.GetCellData().GetArray("FaceId"))
    a, b, c = (points[triangles[:, k]] for k in range(3))
    enclosed = numpy.einsum("ij,ij->", a, numpy.cross(b, c)) / 6

    tetrahedra = mesh.cells_dict["tetra"]
    p, q, r, s = (mesh.points[tetrahedra[:, k]] for k in range(4))
    volumes = numpy.einsum("ij,ij->i", q - p, numpy.cross(r - p, s - p)) / 6
    assert volumes.min() > 0, f"a tetrahedron is inside out: {volumes.min()}"
    assert abs(volumes.sum() / enclosed - 1) < 1e-9, f"{volumes.sum()} of {enclosed} m^3"
    names = {int(tag): name for name, (tag, dimension) in mesh.field_data.items() if dimension == 2}
    tags = mesh.cell_data_dict["gmsh:physical"]["triangle"]
    patches = {names[int(tag)]: areas(mesh.points, mesh.cells_dict["triangle"][tags == tag]).sum() for tag in numpy.unique(tags)}
    caps = {node["cap"] for node in json.loads((out / "result.json").read_text())["graph"]["nodes"] if node["cap"] is not None}
    assert set(patches) == {"wall"} | {f"end_{cap}" for cap in caps}, patches
    for name, area in patches.items():
        face = 0 if name == "wall" else int(name.removeprefix("end_"))
        assert abs(area / areas(points, triangles[faces == face]).sum() - 1) < 1e-9, name
    worst = float(said.split("(SICN) ")[1].split()[0])
    assert worst > 0.1, said
    print(f"volume mesh: {said.strip()}; it fills the surface with its extensions to 1e-9")


main()
