"""A series of variants in one call, and the table of all of them: over HTTP and on the command line the same numbers.

The medians and the deviations are held against numpy's, the table's rows against the results themselves.
"""

import csv
import io
import json
import os
import pathlib
import subprocess
import tempfile

import numpy
import requests
from shared.serving import serve

scan = pathlib.Path(os.environ["VASCULUM_SCAN"])
binary = os.environ["VASCULUM_BIN"]
ASKED = [30, 50, 60]


class Caller:
    def __init__(self, address, key):
        self.address, self.session = address, requests.Session()
        self.session.headers["Authorization"] = "Bearer " + key

    def get(self, path, **more):
        answer = self.session.get(self.address + path, timeout=90, **more)
        answer.raise_for_status()
        return answer

    def post(self, path, **more):
        return self.session.post(self.address + path, timeout=90, **more)

    def ended(self, job):
        for _ in range(10):
            told = self.get(f"/v1/jobs/{job}?wait=60").json()
            if told["state"] in ("succeeded", "failed", "cancelled"):
                return told
        raise AssertionError(f"the job does not end: {told}")


def series(caller):
    """A reconstruction and its variants; their ids in the order of the request."""
    files = [("input", (file.name, file.read_bytes())) for file in sorted((scan / "dicom").glob("*.dcm"))]
    plan = json.loads((scan / "plan.json").read_text()) | {"outputs": ["field"]}
    files.append(("plan", (None, json.dumps(plan))))
    first = caller.post("/v1/jobs", files=files).json()["id"]
    assert caller.ended(first)["state"] == "succeeded"
    plan = lambda deg: {"variant": {"changes": [{"branch": "graft", "angle_deg": deg}]}}
    refused = caller.post(f"/v1/jobs/{first}/plans", json={"plans": [plan(30), plan(300), {"variant": {"changes": [{"branch": "graff", "planar": True}]}}]})
    fields = [fault["where"]["field"] for fault in refused.json()["errors"]]
    assert refused.status_code == 422 and [f.split(".")[0] for f in fields] == ["plans[1]", "plans[2]"], refused.text
    assert len(caller.get("/v1/jobs").json()["items"]) == 1, "none of the three was accepted"
    made = caller.post(f"/v1/jobs/{first}/plans", json={"plans": [plan(deg) for deg in ASKED]}, headers={"Idempotency-Key": "series"})
    assert made.status_code == 202, made.text
    ids = [job["id"] for job in made.json()["items"]]
    for job, deg in zip(ids, ASKED, strict=True):
        told = caller.ended(job)
        assert (told["state"], told["kind"], told["parent"]) == ("succeeded", "variant", first), told
        angles = caller.get(f"/v1/jobs/{job}/result").json()["junctions"][0]["angles"]
        measured = next(a["value"] for a in angles if a["name"] == "graft_proximal")
        assert abs(measured - deg) < 0.3, f"asked for {deg}, measured {measured}"
    listed = caller.get(f"/v1/jobs?parent={first}").json()["items"]
    assert [job["id"] for job in listed] == ids[::-1]
    return [first, *ids]


def corrected(caller, first):
    """Other roles on the same scan: the bytes of a whole run by the command line, though the fit is taken from the first job."""
    plan = caller.get(f"/v1/jobs/{first}/plan").json()
    roles = plan["roles"]
    roles["proximal_mm"], roles["distal_mm"] = roles["distal_mm"], roles["proximal_mm"]
    job = caller.post("/v1/jobs", json={"job": first, "plan": plan}).json()["id"]
    assert caller.ended(job)["state"] == "succeeded"
    files = {f["name"]: f["digest"] for f in caller.get(f"/v1/jobs/{job}/artefacts").json()["items"]}
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        (folder / "plan.json").write_text(json.dumps(plan))
        subprocess.run([binary, "run", str(scan / "dicom"), "--plan", str(folder / "plan.json"), "--out", str(folder / "out")], check=True, capture_output=True, timeout=120)
        whole = json.loads((folder / "out/provenance.json").read_text())
    here = caller.get(f"/v1/jobs/{job}/artefacts/provenance.json").json()
    assert (whole["recalled"], here["recalled"]) == (0, 4)
    del files["provenance.json"]
    assert files == {f["name"]: f["digest"] for f in whole["artefacts"]}, "other bytes than a whole run's"
    caller.session.delete(f"{caller.address}/v1/jobs/{job}", timeout=30)
    took = [sum(s["cpu_s"] for s in told["stages"] if s["stage"] in ("fit", "smooth")) for told in (whole, here)]
    return f"other roles take {took[1]:.1f} s of fit and smoothing instead of {took[0]:.1f}"


def folders(caller, jobs, folder):
    """The results as the command line has them, each in a folder named after its job."""
    for job in jobs:
        (folder / job).mkdir()
        (folder / job / "result.json").write_bytes(caller.get(f"/v1/jobs/{job}/artefacts/result.json").content)
    return [str(folder / job) for job in jobs]


def command(*arguments):
    return subprocess.run([binary, "cohort", *arguments], check=True, capture_output=True, timeout=60).stdout


def same_numbers(caller, jobs):
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        inputs = folders(caller, jobs, folder)
        here = json.loads(command(*inputs, "--json"))
        there = caller.get("/v1/cohort", params={"id": ",".join(jobs)}).json()
        assert [r.pop("created_at")[:2] for r in there["results"]] == ["20"] * len(jobs)
        assert here == there, "the command line and the service tell different tables"
        command(*inputs, "--out", str(folder / "out"))
        table = caller.get("/v1/cohort", params={"id": ",".join(jobs)}, headers={"Accept": "text/csv"}).content
        assert table == (folder / "out/cohort.csv").read_bytes()
        for query, options in [
            ({"name": "graft_proximal,graft", "quantity": "deg,diameter_mm"}, ["--name", "graft_proximal", "--name", "graft", "--quantity", "deg", "--quantity", "diameter_mm"]),
            ({"kind": "branch", "branch": "0,2"}, ["--kind", "branch", "--branch", "0", "--branch", "2"]),
            ({"job_kind": "variant", "kind": "angle"}, ["--job-kind", "variant", "--kind", "angle"]),
            ({"without_warnings": "true"}, ["--without-warnings"]),
        ]:
            asked = caller.get("/v1/cohort", params={"id": ",".join(jobs), "format": "csv", **query}).content
            (folder / "again").mkdir(exist_ok=True)
            command(*inputs, *options, "--out", str(folder / "again"))
            assert asked == (folder / "again/cohort.csv").read_bytes(), query
    return there


def right(table, caller, jobs):
    """Rows against the results, sums against numpy's."""
    results = {job: caller.get(f"/v1/jobs/{job}/result").json() for job in jobs}
    for row in table["rows"]:
        result = results[row["job"]]
        if row["kind"] == "angle":
            junction = next(j for j in result["junctions"] if j["node"] == row["id"])
            angle = next(a for a in junction["angles"] if a["name"] == row["name"])
            assert (row["value"], row["band95"]) == (angle["value"], angle["band95"])
        elif row["quantity"] in ("diameter_mm", "length_mm", "tortuosity"):
            branch = next(b for b in result["branches"] if b["id"] == row["id"])
            assert (row["name"], row["value"]) == (branch["role"], branch[row["quantity"]])
    assert {fact["job"]: fact["variant"] for fact in table["results"]} == {job: job != jobs[0] for job in jobs}
    for spread in table["summary"]:
        values = [r["value"] for r in table["rows"] if (r["name"], r["quantity"]) == (spread["name"], spread["quantity"])]
        values = numpy.array([v for v in values if v is not None])
        assert spread["count"] == len(values)
        told = [spread[key] for key in ("min", "q1", "median", "q3", "max")]
        assert numpy.allclose(told, numpy.quantile(values, [0, 0.25, 0.5, 0.75, 1]), rtol=1e-12, atol=1e-12)
        assert numpy.isclose(spread["mean"], values.mean(), rtol=1e-12)
        assert numpy.isclose(spread["standard_deviation"], values.std(ddof=1), rtol=1e-9, atol=1e-12)
    angle = next(s for s in table["summary"] if s["name"] == "graft_proximal")
    assert angle["count"] == len(jobs) and abs(angle["min"] - ASKED[0]) < 0.3


def filtered(caller, jobs):
    newest_first = [fact["job"] for fact in caller.get("/v1/cohort").json()["results"]]
    assert newest_first == jobs[::-1]
    born = caller.get(f"/v1/jobs/{jobs[1]}").json()["created_at"]
    of = lambda **query: [fact["job"] for fact in caller.get("/v1/cohort", params=query).json()["results"]]
    assert of(created_before=born) == jobs[:1]
    assert of(created_after=born) == jobs[:0:-1]
    assert of(job_kind="reconstruction") == jobs[:1]
    rows = list(csv.DictReader(io.StringIO(caller.get("/v1/cohort?format=csv&quantity=deg&name=graft_proximal").text)))
    assert len(rows) == len(jobs) and all(row["quantity"] == "deg" for row in rows)
    caller.session.delete(f"{caller.address}/v1/jobs/{jobs[-1]}", timeout=30)
    assert of() == jobs[-2::-1], "an erased job is in no table"


def main():
    with tempfile.TemporaryDirectory() as folder:
        process, address, key = serve(folder, "--workers", "2", stderr=subprocess.DEVNULL)
        try:
            caller = Caller(address, key)
            jobs = series(caller)
            spared = corrected(caller, jobs[0])
            table = same_numbers(caller, jobs)
            right(table, caller, jobs)
            filtered(caller, jobs)
        finally:
            process.terminate()
            process.wait(timeout=30)
    print(f"cohort: {len(table['rows'])} rows of {len(jobs)} jobs as on the command line; {len(table['summary'])} spreads are numpy's; {spared}")


main()
