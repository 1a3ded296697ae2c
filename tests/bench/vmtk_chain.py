"""VMTK's chain on one scan or on one surface; `cargo xtask bench accuracy` runs it beside ours (tests/bench/accuracy.py).

    python tests/bench/vmtk_chain.py scan SCAN.nii TRUTH.json OUT.json
    python tests/bench/vmtk_chain.py surface SURFACE.vtp TRUTH.json OUT.json

`scan`: half-level surface by marching cubes, the piece at the known vessel, ends cut square to the known axes, remeshing to
.8 mm, centrelines, branches, bifurcation vectors, sections. VMTK is given what it does not find by itself: the level
(half-way between the lumen's and the surroundings' medians in this scan), the vessel, its ends, which is the inlet, and the
place from which distances are measured. That is not timed. `surface`: the centrelines and vectors on a closed surface with
caps (FaceId). Every end is the inlet once. A centreline is right when it runs from end to end and keeps to the true axes,
outside the junction, by less than half a radius; VMTK itself says nothing of a wrong one.
"""

import contextlib
import json
import sys
import time

import numpy as np
from vmtk import vmtkscripts, vtkvmtk
from vtkmodules import all as vtk
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy

EDGE_MM = 0.8
RADIUS = "MaximumInscribedSphereRadius"
# Graft diameters from the junction between which lines are fitted; result.json's default end.
FROM_DIAMETERS, TO_DIAMETERS = 1.5, 4.0
SECTIONS = 8  # sections of a branch, one sphere apart


class Branch:
    def __init__(self, told, start):
        self.role, self.radius, self.start = told["role"], told["radius_mm"], np.array(start)
        self.direction, self.length = np.array(told["direction"]), told["length_mm"]
        self.circular_from = told["circular_from_mm"]
        self.end = None

    def along(self, x):
        return (x - self.start) @ self.direction

    def off(self, x):
        x = x - self.start
        return np.linalg.norm(x - (x @ self.direction)[..., None] * self.direction, axis=-1)


class Stages:
    """Wall and CPU seconds by stage."""

    def __init__(self):
        self.all = {}

    @contextlib.contextmanager
    def of(self, name):
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.all[name] = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def angles(directions):
    """The three angles of result.json from directions away from the junction, degrees."""
    graft, proximal, distal = (directions[r] / np.linalg.norm(directions[r]) for r in ("graft", "proximal", "distal"))
    normal = np.cross(proximal, graft)
    normal /= np.linalg.norm(normal)
    planar = distal - (distal @ normal) * normal

    def between(a, b):
        return float(np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))

    return {"graft_proximal": between(graft, proximal), "graft_distal_planar": between(graft, planar), "distal_normal": between(distal, normal)}


def script(name, **members):
    made = getattr(vmtkscripts, name)()
    made.LogOn = 0
    for member, value in members.items():
        setattr(made, member, value)
    made.Execute()
    return made


def points(data):
    return vtk_to_numpy(data.GetPoints().GetData()).astype(float)


def lines(data):
    """Point numbers of each line."""
    cells = data.GetLines()
    begin, ids = vtk_to_numpy(cells.GetOffsetsArray()), vtk_to_numpy(cells.GetConnectivityArray())
    return [ids[a:b] for a, b in zip(begin[:-1], begin[1:])]


def scan(path):
    """Grey values and the matrix from their indices to LPS, mm."""
    import nibabel

    image = nibabel.load(path)
    return np.asarray(image.dataobj, dtype=np.float32), np.diag([-1.0, -1, 1, 1]) @ image.affine


def level(grey, matrix, branches):
    """Half-way between the medians of the lumen about the true axes and of what surrounds them."""
    index = np.stack(np.meshgrid(*map(np.arange, grey.shape), indexing="ij"), -1).reshape(-1, 3)
    x = index @ matrix[:3, :3].T + matrix[:3, 3]
    inside, near, clear = np.zeros(len(x), bool), np.zeros(len(x), bool), np.ones(len(x), bool)
    for b in branches:
        along, off = b.along(x), b.off(x)
        beside = (along > 0) & (along < b.length)
        inside |= beside & (off < 0.5 * b.radius)
        near |= beside & (off > 1.8 * b.radius) & (off < 2.6 * b.radius)
        clear &= ~beside | (off > 1.8 * b.radius)
    values = grey.reshape(-1)
    return float(np.median(values[inside]) + np.median(values[near & clear])) / 2


def set_ends(branches, shape, matrix):
    """The farthest cut square to each axis that holds the whole vessel, with a voxel and a quarter of a radius to spare."""
    inverse = np.linalg.inv(matrix)
    for b in branches:
        u = np.cross(b.direction, np.eye(3)[np.argmin(abs(b.direction))])
        u /= np.linalg.norm(u)
        turn = np.linspace(0, 2 * np.pi, 24)[:, None]
        ring = 1.25 * b.radius * (np.cos(turn) * u + np.sin(turn) * np.cross(b.direction, u))
        for s in np.arange(b.length, b.circular_from, -0.25):
            index = (b.start + s * b.direction + ring) @ inverse[:3, :3].T + inverse[:3, 3]
            if (index >= 1).all() and (index <= np.array(shape) - 2).all():
                b.end = b.start + s * b.direction
                break


def half_level(image, value, matrix, branches):
    """Marching cubes; the piece at the vessel; open at the ends."""
    raw = script("vmtkMarchingCubes", Image=image, Level=value).Surface
    place = vtk.vtkTransform()
    place.SetMatrix(matrix.ravel().tolist())
    moved = vtk.vtkTransformPolyDataFilter()
    moved.SetInputData(raw)
    moved.SetTransform(place)
    moved.Update()
    surface = moved.GetOutput()
    for b in branches:
        beyond, beside, both = vtk.vtkPlane(), vtk.vtkCylinder(), vtk.vtkImplicitBoolean()
        beyond.SetOrigin(b.end)
        beyond.SetNormal(-b.direction)
        beside.SetCenter(b.end)
        beside.SetAxis(b.direction)
        beside.SetRadius(2.5 * b.radius)
        both.SetOperationTypeToIntersection()
        both.AddFunction(beyond)
        both.AddFunction(beside)
        cut = vtk.vtkClipPolyData()
        cut.SetInputData(surface)
        cut.SetClipFunction(both)
        cut.Update()
        surface = cut.GetOutput()
    piece = vtk.vtkPolyDataConnectivityFilter()
    piece.SetInputData(surface)
    piece.SetExtractionModeToClosestPointRegion()
    piece.SetClosestPoint(branches[0].start + 0.6 * (branches[0].end - branches[0].start))
    clean = vtk.vtkCleanPolyData()
    clean.SetInputConnection(piece.GetOutputPort())
    clean.Update()
    return clean.GetOutput()


def closed(surface):
    """Capped as vmtkcenterlines caps it, then cleaned: its caps have triangles without area (VMTK's issue 329), of which the
    Voronoi diagram may fail."""
    capper, clean, triangles = vtkvmtk.vtkvmtkCapPolyData(), vtk.vtkCleanPolyData(), vtk.vtkTriangleFilter()
    capper.SetInputData(surface)
    clean.SetInputConnection(capper.GetOutputPort())
    clean.ToleranceIsAbsoluteOn()
    clean.SetAbsoluteTolerance(0.02)
    triangles.SetInputConnection(clean.GetOutputPort())
    triangles.PassLinesOff()
    triangles.PassVertsOff()
    triangles.Update()
    return triangles.GetOutput()


def legs(centrelines, branches, inlet):
    """Points and radii of each branch's part of the lines, outward; the inlet's from the first line."""
    at, radius, found = points(centrelines), vtk_to_numpy(centrelines.GetPointData().GetArray(RADIUS)), {}
    for ids in lines(centrelines):
        x = at[ids]
        if np.linalg.norm(x[0] - inlet.end) > np.linalg.norm(x[-1] - inlet.end):
            ids, x = ids[::-1], x[::-1]
        outlet = min(branches, key=lambda b: np.linalg.norm(x[-1] - b.end))
        middle = int(np.argmin(np.linalg.norm(x - inlet.start, axis=1)))
        found.setdefault(inlet.role, (x[middle::-1], radius[ids][middle::-1]))
        found[outlet.role] = (x[middle:], radius[ids][middle:])
    return found


def fault(found, branches):
    """Why these are not the vessel's centrelines."""
    for b in branches:
        if b.role not in found:
            return f"no line to {b.role}"
        x = found[b.role][0]
        if np.linalg.norm(x[-1] - b.end) > b.radius:
            return f"the line to {b.role} ends {np.linalg.norm(x[-1] - b.end):.1f} mm from its end"
        beyond = b.along(x) > b.circular_from
        if not beyond.any() or b.off(x[beyond]).max() > 0.5 * b.radius:
            return f"the line to {b.role} leaves its axis"
    return None


def even(x, values, step=0.1):
    """The same line in steps of one length: VMTK's points lie where they please."""
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(x, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(arc) > 1e-9])
    at = np.arange(0, arc[-1], step)
    return np.stack([np.interp(at, arc[keep], x[keep, k]) for k in range(3)], 1), np.interp(at, arc[keep], values[keep])


def measured(found, branches):
    """Angles of fitted lines; the radius over the true one and the distance from the true axis, by branch."""
    diameter = 2 * next(b.radius for b in branches if b.role == "graft")
    directions, radius, off = {}, {}, []
    for b in branches:
        x, r = even(*found[b.role])
        along = b.along(x)
        window = x[(along >= FROM_DIAMETERS * diameter) & (along <= TO_DIAMETERS * diameter)]
        axis = np.linalg.svd(window - window.mean(0))[2][0]
        directions[b.role] = axis * np.sign(axis @ (window[-1] - window[0]))
        clear = (along > b.circular_from) & (along < b.along(b.end) - b.radius)
        radius[b.role] = float(np.median(r[clear]) / b.radius - 1)
        off.append(float(np.sqrt((b.off(x[clear]) ** 2).mean())))
    return {"angles": angles(directions), "radius": radius, "centreline_rms_mm": off}


def bifurcation(branched, branches, inlet):
    """VMTK's vectors at the bifurcation: their angles by result.json's definitions and by VMTK's own."""
    systems = script("vmtkBifurcationReferenceSystems", Centerlines=branched).ReferenceSystems
    made = script("vmtkBifurcationVectors", Centerlines=branched, ReferenceSystems=systems).BifurcationVectors
    if made.GetNumberOfPoints() != 3:
        return {"why": f"{made.GetNumberOfPoints()} vectors"}
    array = {n: vtk_to_numpy(made.GetPointData().GetArray(n)) for n in ("BifurcationVectors", "InPlaneBifurcationVectorAngles", "OutOfPlaneBifurcationVectorAngles", "GroupIds")}
    group, at = vtk_to_numpy(branched.GetCellData().GetArray("GroupIds")), points(branched)
    outward, in_plane, out_of_plane = {}, {}, {}
    for k, own in enumerate(array["GroupIds"]):
        ids = lines(branched)[int(np.flatnonzero(group == own)[0])]
        upstream = np.linalg.norm(at[ids[0]] - inlet.end) < inlet.radius
        role = inlet.role if upstream else min(branches, key=lambda b: np.linalg.norm(at[ids[-1]] - b.end)).role
        outward[role] = array["BifurcationVectors"][k] * (-1 if upstream else 1)
        in_plane[role] = float(np.degrees(array["InPlaneBifurcationVectorAngles"][k]))
        out_of_plane[role] = float(np.degrees(array["OutOfPlaneBifurcationVectorAngles"][k]))
    if len(outward) != 3:
        return {"why": "branches and ends do not match"}
    return {"angles": angles(outward), "in_plane": in_plane, "out_of_plane": out_of_plane}


def sections(surface, branched, branches):
    """Mean area of closed sections over the true one, by branch, outside the junction and away from the ends."""
    clipped = script("vmtkBranchClipper", Surface=surface, Centerlines=branched)
    areas = {b.role: [] for b in branches}
    for spheres in range(1, SECTIONS + 1):
        made = script("vmtkBranchSections", Surface=clipped.Surface, Centerlines=branched, NumberOfDistanceSpheres=spheres).BranchSections
        for k in range(made.GetNumberOfCells()):
            x = vtk_to_numpy(made.GetCell(k).GetPoints().GetData()).mean(0)
            b = min(branches, key=lambda b: np.linalg.norm(x - b.start - max(b.along(x), 0) * b.direction))
            if made.GetCellData().GetArray("BranchSectionClosed").GetValue(k) and b.circular_from < b.along(x) < b.along(b.end) - b.radius:
                areas[b.role].append(made.GetCellData().GetArray("BranchSectionArea").GetValue(k))
    return {b.role: float(np.mean(areas[b.role]) / (np.pi * b.radius**2) - 1) if areas[b.role] else None for b in branches}


def by_inlet(surface, branches, with_sections):
    """The lines with each end as the inlet."""
    told = {}
    for inlet in branches:
        stages = Stages()
        said = vtk.vtkStringOutputWindow()
        vtk.vtkOutputWindow.SetInstance(said)
        with stages.of("centreline"):
            targets = np.concatenate([b.end for b in branches if b is not inlet]).tolist()
            seeds = {"SeedSelectorName": "pointlist", "SourcePoints": inlet.end.tolist(), "TargetPoints": targets}
            centrelines = script("vmtkCenterlines", Surface=surface, AppendEndPoints=1, **seeds).Centerlines
        result = told[inlet.role] = {"said": said.GetOutput().strip(), "stages": stages.all}
        found = legs(centrelines, branches, inlet) if centrelines.GetNumberOfPoints() else {}
        result["why"] = fault(found, branches)
        if result["why"]:
            continue
        result.update(measured(found, branches))
        with stages.of("branches and vectors"):
            branched = script("vmtkBranchExtractor", Centerlines=centrelines).Centerlines
            result["vectors"] = bifurcation(branched, branches, inlet)
        if with_sections:
            with stages.of("sections"):
                result["areas"] = sections(surface, branched, branches)
    return told


def on_scan(path, branches):
    grey, matrix = scan(path)
    value = level(grey, matrix, branches)
    set_ends(branches, grey.shape, matrix)
    image = vtk.vtkImageData()
    image.SetDimensions(grey.shape)
    image.GetPointData().SetScalars(numpy_to_vtk(grey.ravel(order="F"), deep=True))
    stages = Stages()
    with stages.of("surface"):
        raw = half_level(image, value, matrix, branches)
    with stages.of("remesh"):
        surface = script("vmtkSurfaceRemeshing", Surface=raw, ElementSizeMode="edgelength", TargetEdgeLength=EDGE_MM).Surface
        surface = closed(surface)
    return {
        "level": value,
        "triangles": [raw.GetNumberOfCells(), surface.GetNumberOfCells()],
        "stages": stages.all,
        "inlets": by_inlet(surface, branches, True),
    }


def on_surface(path, branches):
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(path)
    reader.Update()
    surface = reader.GetOutput()
    face, at = vtk_to_numpy(surface.GetCellData().GetArray("FaceId")), points(surface)
    corners = vtk_to_numpy(surface.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    caps = [at[np.unique(corners[face == k])].mean(0) for k in range(1, face.max() + 1)]
    for b in branches:
        b.end = min((c for c in caps), key=lambda c: b.off(c) if b.along(c) > 0 else np.inf)

    return {"triangles": surface.GetNumberOfCells(), "inlets": by_inlet(surface, branches, False)}


def main():
    what, path, truth, out = sys.argv[1:]
    vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)
    with open(truth) as file:
        truth = json.load(file)
    branches = [Branch(b, truth["junction"]["axes_point"]) for b in truth["branches"] if b["role"] in ("graft", "proximal", "distal")]
    told = {"scan": on_scan, "surface": on_surface}[what](path, branches)
    with open(out, "w") as file:
        json.dump(told, file, indent=1)


if __name__ == "__main__":
    main()
