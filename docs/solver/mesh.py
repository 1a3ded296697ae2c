"""Fills a vessel with tetrahedra: surface_extended.vtp (mm) becomes a Gmsh file (m) whose patches are `wall` and `end_1`, `end_2`, ...

    python mesh.py RESULT/surface_extended.vtp vessel.msh

`end_N` is the end whose node has `"cap": N` in result.json. The surface's own triangles stay as they are. Needs gmsh, vtk, numpy.
"""

import sys

import gmsh
import numpy
from vtk import vtkXMLPolyDataReader
from vtk.util.numpy_support import vtk_to_numpy

source, target = sys.argv[1:3]
reader = vtkXMLPolyDataReader()
reader.SetFileName(source)
reader.Update()
surface = reader.GetOutput()
points = vtk_to_numpy(surface.GetPoints().GetData()) / 1000
triangles = vtk_to_numpy(surface.GetPolys().GetConnectivityArray()).reshape(-1, 3) + 1
faces = vtk_to_numpy(surface.GetCellData().GetArray("FaceId"))
patches = sorted({int(face) for face in faces})

gmsh.initialize()
gmsh.option.setNumber("General.Verbosity", 2)
for patch in patches:
    gmsh.model.addDiscreteEntity(2, patch + 1)
# All nodes lie on the first surface until they are classified anew: the patches share those of their rims.
gmsh.model.mesh.addNodes(2, patches[0] + 1, range(1, len(points) + 1), points.ravel())
first = 1
for patch in patches:
    mine = triangles[faces == patch]
    gmsh.model.mesh.addElementsByType(patch + 1, 2, range(first, first + len(mine)), mine.ravel())
    gmsh.model.addPhysicalGroup(2, [patch + 1], name="wall" if patch == 0 else f"end_{patch}")
    first += len(mine)
gmsh.model.mesh.reclassifyNodes()
gmsh.model.mesh.createTopology()
loop = gmsh.model.geo.addSurfaceLoop([patch + 1 for patch in patches])
lumen = gmsh.model.geo.addVolume([loop])
gmsh.model.geo.synchronize()
gmsh.model.addPhysicalGroup(3, [lumen], tag=len(patches) + 1, name="lumen")
gmsh.option.setNumber("Mesh.Algorithm3D", 10)  # HXT
gmsh.option.setNumber("Mesh.MshFileVersion", 2.2)  # what gmshToFoam reads
gmsh.model.mesh.generate(3)
_, tetrahedra, _ = gmsh.model.mesh.getElements(3)
quality = gmsh.model.mesh.getElementQualities(tetrahedra[0], "minSICN")
print(f"{len(tetrahedra[0])} tetrahedra, quality (SICN) {min(quality):.2f} at worst, {numpy.median(quality):.2f} in the middle")
gmsh.write(target)
gmsh.finalize()
