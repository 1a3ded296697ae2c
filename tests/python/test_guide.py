"""docs/api.md is executed as it stands: its shell blocks by bash in one go, its programs with the clients that are generated
from the running service's own description. What they print is the result's angles, the same from all three."""

import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import zipfile

import requests
from shared.serving import serve

root = pathlib.Path(os.environ["VASCULUM_ROOT"])
scan = pathlib.Path(os.environ["VASCULUM_SCAN"])
node = pathlib.Path(os.environ["VASCULUM_NODE"])
PROGRAMS = {"python": "angles.py", "ts": "angles.mts"}


def laid_out(folder):
    """The guide's programs beside a scan; its shell blocks as one script."""
    with zipfile.ZipFile(folder / "scan.zip", "w") as archive:
        for file in sorted((scan / "dicom").glob("*.dcm")):
            archive.write(file, file.name)
    (folder / "node_modules").symlink_to(node / "node_modules")
    shell = ["set -euo pipefail"]
    for language, text in re.findall(r"^```(\w+)\n(.*?)^```$", (root / "docs/api.md").read_text(), re.M | re.S):
        if language == "sh":
            shell.append(text)
        else:
            (folder / PROGRAMS.pop(language)).write_text(text)
    assert not PROGRAMS, f"the guide has no {PROGRAMS}"
    (folder / "guide.sh").write_text("\n".join(shell))


def executed(folder, address, key):
    tools = f"{pathlib.Path(sys.executable).parent}:{node / 'node_modules/.bin'}"
    env = {**os.environ, "SERVICE": address, "VASCULUM_KEY": key, "PATH": f"{tools}:{os.environ['PATH']}"}
    done = subprocess.run(["bash", "guide.sh"], cwd=folder, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    return done.stdout


def judged(folder, said, session, address):
    jobs = session.get(address + "/v1/jobs?limit=20", timeout=30).json()["items"]
    assert [job["state"] for job in jobs] == ["succeeded"] * 4, jobs
    kinds = [job["kind"] for job in reversed(jobs)]
    assert kinds == ["reconstruction", "variant", "variant", "reconstruction"]
    result = session.get(f"{address}/v1/jobs/{jobs[-1]['id']}/result", timeout=30).json()
    lines = [line.split() for line in said.splitlines()]
    for angle in result["junctions"][0]["angles"]:
        name, value = angle["name"], angle["value"]
        two, (low, high) = f"{value:.2f}", (f"{x:.2f}" for x in angle["band95"])
        by_python = [name, two, f"({low}", "..", f"{high})"]
        assert by_python in lines and [name, two] in lines, f"{name} in\n{said}"
        exact = [line for line in lines if line[:1] == [name] and len(line) == 4]
        assert any(json.loads(line[1]) == value for line in exact), f"{name} by curl"
    assert (folder / "surface.stl").stat().st_size > 80 and (folder / "report-2.html").read_bytes() == (folder / "report.html").read_bytes()
    assert (folder / "cohort.csv").read_text().startswith("job,kind,id,name")
    assert "graft" in (folder / "angles.csv").read_text()


def main():
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        laid_out(folder)
        process, address, key = serve(folder / "data", "--workers", "2", stderr=subprocess.DEVNULL)
        try:
            said = executed(folder, address, key)
            session = requests.Session()
            session.headers["Authorization"] = "Bearer " + key
            judged(folder, said, session, address)
        finally:
            process.terminate()
            process.wait(timeout=30)
    print("guide: its shell blocks, and clients generated in Python and TypeScript, read the same angles")


main()
