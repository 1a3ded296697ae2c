"""Ends of the surface: their names hold under another edge length and another noise, cuts lie where the plan wants them.

    VASCULUM_BIN=vasculum VASCULUM_OUT=RESULT VASCULUM_SCAN=SCAN python tests/python/test_ends.py

RESULT is that of SCAN with its plan; the tables are read by VTK.
"""

import json
import os
import pathlib
import subprocess
import tempfile

import numpy as np
import vtk
from vtk.util.numpy_support import vtk_to_numpy

BIN = os.environ["VASCULUM_BIN"]
OUT = pathlib.Path(os.environ["VASCULUM_OUT"])
SCAN = pathlib.Path(os.environ["VASCULUM_SCAN"])
WORK = tempfile.TemporaryDirectory()


def run(name, plan, scan=SCAN):
    folder = pathlib.Path(WORK.name)
    out, file = folder / name, folder / f"{name}.json"
    file.write_text(json.dumps(plan))
    command = [BIN, "run", str(scan / "dicom"), "--plan", str(file), "--out", str(out), "--json"]
    return out, subprocess.run(command, capture_output=True, text=True)


def plan(**more):
    return json.loads((SCAN / "plan.json").read_text()) | more


def result(folder):
    return json.loads((folder / "result.json").read_text())


def ends(folder):
    caps = result(folder)["surface"]["caps"]
    return {c["boundary"]: (c["face_id"], c["name"], np.array(c["centroid"])) for c in caps}


def surface(folder):
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(folder / "surface.vtp"))
    reader.Update()
    return reader.GetOutput()


def named(poly):
    names = poly.GetFieldData().GetAbstractArray("FaceNames")
    return [names.GetValue(k) for k in range(names.GetNumberOfValues())]


def points_of(poly, face):
    ids = vtk_to_numpy(poly.GetCellData().GetArray("FaceId"))
    cells = vtk_to_numpy(poly.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    return vtk_to_numpy(poly.GetPoints().GetData())[np.unique(cells[ids == face])]


def test_names():
    first = ends(OUT)
    assert set(first) == {"inlet_1", "inlet_2", "outlet_1"}
    assert [first[b][1] for b in ("inlet_1", "inlet_2", "outlet_1")] == ["end_graft", "end_proximal", "end_distal"]
    names = named(surface(OUT))
    assert names[0] == "wall" and all(names[face] == boundary for boundary, (face, _, _) in first.items())
    noisy = pathlib.Path(WORK.name) / "scan2"
    subprocess.run([BIN, "phantom", "anastomosis", "--seed", "2", "--out", str(noisy)], check=True, capture_output=True)
    edges = plan(surface={"edge_mm": [0.3, 1.6], "max_error_mm": 0.05})
    for out, ran in (run("edges", edges), run("noise", plan(), noisy)):
        assert ran.returncode == 0, ran.stderr
        again = ends(out)
        for boundary, (face, name, at) in first.items():
            assert again[boundary][:2] == (face, name)
            assert np.linalg.norm(again[boundary][2] - at) < 0.5


def test_across():
    """Ends lie across their vessels: in a plane, normal to the true axis, as large as the true section."""
    truth = {b["role"]: b for b in json.loads((SCAN / "truth.json").read_text())["branches"]}
    poly = surface(OUT)
    for cap in result(OUT)["surface"]["caps"]:
        branch = truth[cap["name"].removeprefix("end_")]
        lean = np.degrees(np.arccos(np.dot(cap["normal"], branch["direction"])))
        assert lean < 2, (cap["name"], lean)
        assert cap["oblique_deg"] < 2 and cap["set_back_mm"] >= 0
        assert abs(cap["area_mm2"] / branch["area_mm2"] - 1) < 0.02, cap
        flat = points_of(poly, cap["face_id"])
        off = (flat - flat.mean(0)) @ np.array(cap["normal"])
        assert abs(off).max() <= 1e-6, abs(off).max()
    graft = next(c for c in result(OUT)["surface"]["caps"] if c["name"] == "end_graft")
    assert 2 < graft["set_back_mm"] < 4.5  # 2.5 tan 45 degrees and the margin


def test_cut():
    """The graft ends where the plan wants it; the rest of the vessel is as it was."""
    whole = result(OUT)
    branch = next(b for b in whole["branches"] if b["role"] == "graft")
    at = np.array(branch["samples"]["position"][int(0.6 * len(branch["samples"]["position"]))])
    out, ran = run("cut", plan(ends={"cut_mm": [list(at + 0.8 * np.array([0.0, 1.0, 0.0]))], "extension_diameters": 2}))
    assert ran.returncode == 0, ran.stderr
    now = result(out)
    cap = next(c for c in now["surface"]["caps"] if c["name"] == "end_graft")
    assert np.linalg.norm(np.array(cap["centroid"]) - at) < 1.0
    assert len(now["surface"]["caps"]) == 3 and now["surface"]["euler"] == 2 and now["surface"]["components"] == 1
    flat = points_of(surface(out), cap["face_id"])
    off = (flat - flat.mean(0)) @ np.array(cap["normal"])
    assert abs(off).max() <= 1e-6, abs(off).max()  # nine digits are written of the normal
    area = np.pi / 4 * branch["diameter_mm"] ** 2
    assert abs(cap["area_mm2"] / area - 1) < 0.03, (cap["area_mm2"], area)
    assert now["surface"]["volume_mm3"] < whole["surface"]["volume_mm3"]
    angles = [{a["name"]: a["value"] for a in r["junctions"][0]["angles"]} for r in (whole, now)]
    assert abs(angles[0]["proximal_distal"] - angles[1]["proximal_distal"]) < 0.3


def test_faults():
    whole = result(OUT)
    junction = whole["junctions"][0]["medial_point"]
    for wanted, code in ((junction, "ends.junction"), ([junction[0] + 40, junction[1] + 40, junction[2]], "ends.far")):
        _, ran = run(code, plan(ends={"cut_mm": [wanted]}))
        assert ran.returncode == 2, ran.stderr
        problem = json.loads(ran.stderr[ran.stderr.index("{") :])
        assert problem["code"] == code, problem
        assert "ends.cut_mm[0]" in json.dumps(problem)


if __name__ == "__main__":
    for test in (test_names, test_across, test_cut, test_faults):
        test()
    print("ends keep their names and lie across their vessels, cuts lie where they were asked for, and others are refused with their place")
