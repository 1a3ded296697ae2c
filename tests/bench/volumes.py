"""Are our surfaces the boundary of a volume, for programs that fill volumes? Gmsh and TetGen judge; neither is linked.

    cargo xtask survey --surfaces 200     (or: SURFACES=FOLDER python tests/bench/volumes.py [COUNT] after the survey example)

A surface is accepted when the tetrahedra fill the enclosed volume and every triangle of the boundary is one of ours.
"""

import contextlib
import os
import pathlib
import sys

import gmsh
import numpy as np
import tetgen

FILES = sorted(pathlib.Path(os.environ["SURFACES"]).glob("*.off"))


def off(path):
    rows = path.read_text().split("\n")
    n, m = map(int, rows[1].split()[:2])
    points = np.array([r.split() for r in rows[2 : 2 + n]], float)
    return points, np.array([r.split()[1:] for r in rows[2 + n : 2 + n + m]], int)


def enclosed(points, faces):
    a, b, c = (points[faces[:, k]] - points[0] for k in range(3))
    return (np.cross(a, b) * c).sum() / 6


def filled(points, tets):
    a, b, c, d = (points[tets[:, k]] for k in range(4))
    return np.abs((np.cross(b - a, c - a) * (d - a)).sum(1)).sum() / 6


def boundary(tets):
    faces = np.sort(np.vstack([tets[:, k] for k in ([0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3])]), axis=1)
    kinds, count = np.unique(faces, axis=0, return_counts=True)
    return {tuple(f) for f in kinds[count == 1]}


@contextlib.contextmanager
def quiet():
    """TetGen's library writes two lines a mesh to the process's output."""
    sys.stdout.flush()
    kept, sink = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        os.close(sink)


def by_tetgen(points, faces):
    mesh = tetgen.TetGen(points, faces)
    with quiet():
        made = mesh.tetrahedralize(switches="pYQ")
    return np.asarray(made[0]), np.asarray(made[1])


def by_gmsh(points, faces):
    gmsh.model.add("surface")
    gmsh.model.addDiscreteEntity(2, 1)
    gmsh.model.mesh.addNodes(2, 1, np.arange(1, len(points) + 1), points.ravel())
    gmsh.model.mesh.addElementsByType(1, 2, [], (faces + 1).ravel())
    gmsh.model.geo.addVolume([gmsh.model.geo.addSurfaceLoop([1])], 1)
    gmsh.model.geo.synchronize()
    gmsh.model.mesh.generate(3)
    tags, places, _ = gmsh.model.mesh.getNodes()
    number = np.zeros(int(tags.max()) + 1, int)
    number[tags.astype(int)] = np.arange(len(tags))
    _, nodes = gmsh.model.mesh.getElementsByType(4)
    places, tets = places.reshape(-1, 3), number[nodes.astype(int)].reshape(-1, 4)
    gmsh.model.remove()
    # Our numbers first: Gmsh keeps the tags that it was given.
    order = np.argsort(number[np.arange(1, len(points) + 1)])
    assert (order == np.arange(len(points))).all()
    return places, tets


def fault(judge, points, faces):
    try:
        places, tets = judge(points, faces)
    except Exception as e:
        return f"{type(e).__name__}: {e}"
    if len(tets) == 0:
        return "no tetrahedra"
    off_by = filled(places, tets) / enclosed(points, faces) - 1
    if abs(off_by) > 1e-9:
        return f"volume off by {off_by:.1e}"
    if boundary(tets) != {tuple(f) for f in np.sort(faces, axis=1)}:
        return "another boundary"
    return None


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    chosen = [f for f in FILES if not f.name.startswith("benchmark")][:: max(1, len(FILES) // count)][:count]
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 1)
    bad = []
    for judge in (by_gmsh, by_tetgen):
        refused = [(path.name, why) for path in chosen if (why := fault(judge, *off(path)))]
        print(f"{judge.__name__[3:]}: {len(chosen) - len(refused)} of {len(chosen)} surfaces accepted")
        bad += [(judge.__name__, *r) for r in refused]
    gmsh.finalize()
    if not chosen or bad:
        sys.exit(f"refused: {bad}")


if __name__ == "__main__":
    main()
