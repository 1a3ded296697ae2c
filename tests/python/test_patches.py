"""patches.vtu read by VTK: Lagrange quadrilaterals that cover the wall of surface.vtp, each node in its place.

    VASCULUM_OUT=FOLDER python tests/python/test_patches.py     (a result whose plan asked for `patches`)
"""

import json
import os
import pathlib

import numpy as np
import vtk
from vtk.util.numpy_support import vtk_to_numpy

OUT = pathlib.Path(os.environ["VASCULUM_OUT"])


def read(reader, name):
    reader.SetFileName(str(OUT / name))
    reader.Update()
    return reader.GetOutput()


GRID = read(vtk.vtkXMLUnstructuredGridReader(), "patches.vtu")
SURFACE = read(vtk.vtkXMLPolyDataReader(), "surface.vtp")
SAID = json.loads((OUT / "result.json").read_text())["surface"]["quads"]


def wall(surface):
    keep = vtk.vtkThreshold()
    keep.SetInputData(surface)
    keep.SetInputArrayToProcess(0, 0, 0, vtk.vtkDataObject.FIELD_ASSOCIATION_CELLS, "FaceId")
    keep.SetThresholdFunction(vtk.vtkThreshold.THRESHOLD_BETWEEN)
    keep.SetLowerThreshold(0)
    keep.SetUpperThreshold(0)
    flat = vtk.vtkDataSetSurfaceFilter()
    flat.SetInputConnection(keep.GetOutputPort())
    flat.Update()
    return flat.GetOutput()


def tessellated(grid):
    """VTK's own triangles of the curved cells."""
    fine = vtk.vtkDataSetSurfaceFilter()
    fine.SetInputData(grid)
    fine.SetNonlinearSubdivisionLevel(4)
    triangles = vtk.vtkTriangleFilter()
    triangles.SetInputConnection(fine.GetOutputPort())
    triangles.Update()
    return triangles.GetOutput()


def area(poly):
    properties = vtk.vtkMassProperties()
    properties.SetInputData(poly)
    properties.Update()
    return properties.GetSurfaceArea()


def test_cells():
    assert GRID.GetNumberOfCells() == SAID["patches"] and GRID.GetNumberOfPoints() == SAID["nodes"]
    p = SAID["order"]
    for c in range(GRID.GetNumberOfCells()):
        cell = GRID.GetCell(c)
        assert cell.GetCellType() == vtk.VTK_LAGRANGE_QUADRILATERAL
        assert cell.GetNumberOfPoints() == (p + 1) ** 2 and cell.GetOrder(0) == p and cell.GetOrder(1) == p
    ids = vtk_to_numpy(GRID.GetCellData().GetArray("PatchId"))
    assert set(ids) <= set(vtk_to_numpy(SURFACE.GetCellData().GetArray("PatchId")))


def test_shared_edges():
    """Along every edge of a patch lie the same points of its neighbour, or a rim."""
    seen = {}
    for c in range(GRID.GetNumberOfCells()):
        cell = GRID.GetCell(c)
        for e in range(4):
            edge = cell.GetEdge(e)
            line = tuple(sorted(edge.GetPointId(k) for k in range(edge.GetNumberOfPoints())))
            assert len(line) == SAID["order"] + 1
            seen[line] = seen.get(line, 0) + 1
    assert max(seen.values()) == 2
    corners = {v for c in range(GRID.GetNumberOfCells()) for v in [GRID.GetCell(c).GetPointId(k) for k in range(4)]}
    caps = len(json.loads((OUT / "result.json").read_text())["surface"]["caps"])
    assert len(corners) - len(seen) + GRID.GetNumberOfCells() == 2 - caps


def test_area_and_place():
    """A wrong order of nodes folds the cells: their area and their distance from the surface tell."""
    fine, flat = tessellated(GRID), wall(SURFACE)
    assert abs(area(fine) / area(flat) - 1) < 2e-3, (area(fine), area(flat))
    distance = vtk.vtkImplicitPolyDataDistance()
    distance.SetInput(flat)
    points = vtk_to_numpy(fine.GetPoints().GetData())
    far = [abs(distance.EvaluateFunction(x)) for x in points[:: max(1, len(points) // 5000)]]
    # The triangles' own error is .02 mm, the patches' .01 mm.
    assert max(far) < 0.04, max(far)


def test_outside():
    """Cells are seen counterclockwise from outside, as the triangles are."""
    normals = vtk.vtkPolyDataNormals()
    normals.SetInputData(tessellated(GRID))
    normals.ComputeCellNormalsOn()
    normals.ConsistencyOff()
    normals.AutoOrientNormalsOff()
    normals.SplittingOff()
    normals.Update()
    mine = normals.GetOutput()
    locator = vtk.vtkCellLocator()
    flat = wall(SURFACE)
    locator.SetDataSet(flat)
    locator.BuildLocator()
    theirs = vtk.vtkPolyDataNormals()
    theirs.SetInputData(flat)
    theirs.ComputeCellNormalsOn()
    theirs.ConsistencyOff()
    theirs.SplittingOff()
    theirs.Update()
    outside = vtk_to_numpy(theirs.GetOutput().GetCellData().GetNormals())
    cells = vtk_to_numpy(mine.GetCellData().GetNormals())
    worst = 1.0
    for c in range(0, mine.GetNumberOfCells(), 37):
        points = vtk_to_numpy(mine.GetCell(c).GetPoints().GetData())
        at, cell, sub, square = [0.0] * 3, vtk.reference(0), vtk.reference(0), vtk.reference(0.0)
        locator.FindClosestPoint(points.mean(0), at, cell, sub, square)
        worst = min(worst, float(np.dot(cells[c], outside[int(cell)])))
    assert worst > 0.5, worst


if __name__ == "__main__":
    for test in (test_cells, test_shared_edges, test_area_and_place, test_outside):
        test()
    print(f"{GRID.GetNumberOfCells()} patches of order {SAID['order']} cover the wall, edge to edge")
