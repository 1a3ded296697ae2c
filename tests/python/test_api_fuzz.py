"""schemathesis sends what the document allows, and what it forbids, to every operation of the running binary.

All phases (examples, coverage, fuzzing, stateful) and all checks: no answer outside the document, no 5xx, nothing
invalid accepted, nothing valid refused, no call without its key, nothing that lives on after its erasure. Scans and
webhooks get a valid content by a hook (a schema cannot describe a DICOM file); every operation must have been reached.
"""

import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import urllib.request

from shared.serving import serve
HOOKS = '''
import os
import urllib.request

import schemathesis

SCAN = """ObjectType = Image\\nNDims = 3\\nBinaryData = True\\nBinaryDataByteOrderMSB = False\\nOffset = 0 0 0
TransformMatrix = 1 0 0 0 1 0 0 0 1\\nElementSpacing = 1 1 1\\nDimSize = 16 16 8
ElementType = MET_USHORT\\nElementDataFile = LOCAL\\n""" + "\\0" * (16 * 16 * 8 * 2)


@schemathesis.serializer("application/offset+octet-stream")
def as_it_is(context, value):
    return value if isinstance(value, bytes) else str(value).encode()


@schemathesis.serializer("multipart/related")
def byte_for_byte(context, value):
    # The document says string, so a slice travels as one: a character for each byte.
    return value if isinstance(value, bytes) else str(value).encode("latin-1", "replace")


@schemathesis.hook
def before_call(context, case, kwargs):
    label = case.operation.label
    if case.meta is None or not case.meta.generation.mode.is_positive:
        return
    if label == "POST /v1/jobs" and case.media_type == "multipart/form-data":
        case.body = {"input": [SCAN]}
    elif label == "POST /v1/jobs" and isinstance(case.body, dict):
        # Of a plan the schema says only that it is an object.
        case.body.pop("plan", None)
    elif label == "POST /v1/jobs/{id}/plans" and isinstance(case.body, dict):
        case.body["plans"] = [{}]
    elif label.startswith("POST /dicomweb/studies"):
        with open(os.environ["SLICE"], "rb") as file:
            slice = file.read().decode("latin-1")
        case.body = "--edge\\r\\nContent-Type: application/dicom\\r\\n\\r\\n" + slice + "\\r\\n--edge--\\r\\n"
        case.headers["Content-Type"] = 'multipart/related; type="application/dicom"; boundary=edge'
    elif label == "POST /v1/webhooks":
        case.body = {"url": "https://127.0.0.1:9/told"}
    elif label in ("HEAD /v1/uploads/{id}", "PATCH /v1/uploads/{id}", "DELETE /v1/uploads/{id}"):
        made = urllib.request.Request(
            os.environ["ADDRESS"] + "/v1/uploads", method="POST",
            headers={"Authorization": "Bearer " + os.environ["KEY"], "Tus-Resumable": "1.0.0", "Upload-Length": "4096"},
        )
        try:
            with urllib.request.urlopen(made, timeout=5) as answer:
                case.path_parameters = {"id": answer.headers["Location"].split("/")[-1]}
        except urllib.error.HTTPError:
            # There are as many uploads as a tenant may have: the call finds none.
            return
        if label.startswith("PATCH"):
            case.headers["Upload-Offset"] = "0"
            case.headers.pop("Upload-Checksum", None)
'''

# Operations that change or show something of a job, beside those that need no preparation: each must have been done.
ID = "[0-9a-f-]{36}"
PLACES = [
    ("POST", "/v1/jobs"), ("GET", f"/v1/jobs/{ID}"), ("GET", f"/v1/jobs/{ID}/events"), ("GET", f"/v1/jobs/{ID}/artefacts"),
    ("DELETE", f"/v1/jobs/{ID}"), ("POST", "/v1/webhooks"), ("GET", "/v1/webhooks"), ("DELETE", f"/v1/webhooks/{ID}"),
    ("OPTIONS", "/v1/uploads"), ("POST", "/v1/uploads"), ("HEAD", "/v1/uploads/[0-9a-f]{96}"),
    ("PATCH", "/v1/uploads/[0-9a-f]{96}"), ("DELETE", "/v1/uploads/[0-9a-f]{96}"),
    ("POST", "/dicomweb/studies"), ("GET", "/v1/jobs"), ("POST", "/v1/jobs/cancel"), ("GET", "/v1/audit"), ("GET", "/v1/session"), ("GET", f"/v1/jobs/{ID}/plan"), ("POST", f"/v1/jobs/{ID}/plans"), ("POST", f"/v1/jobs/{ID}/links"), ("GET", "/v1/keys"), ("POST", "/v1/keys"),
    ("GET", "/v1/tenant"), ("PUT", "/v1/tenant"), ("GET", "/v1/stats"), ("GET", "/v1/workers"), ("GET", "/v1/cohort"),
]

# A body's content decides as well as its shape: what the hook does not replace may be refused for it.
SETTINGS = """
[generation]
max-examples = 30

# tus refuses another version with 412.
[checks.negative_data_rejection]
expected-statuses = [400, 401, 403, 404, 405, 406, 409, 412, 413, 415, 422, 423, 428, 429]

# A limit that a schema does not know is a lawful no.
[checks.positive_data_acceptance]
expected-statuses = ["2xx", "3xx", 401, 403, 404, 409, 413, 429, "5xx"]

[checks.missing_required_header]
expected-statuses = [400, 401, 403, 404, 406, 412, 415, 422]
"""


def main():
    root = pathlib.Path(os.environ["VASCULUM_ROOT"]) if "VASCULUM_ROOT" in os.environ else pathlib.Path(__file__).parents[2]
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        process, address, key = serve(folder / "data", "--webhook-host", "127.0.0.1", stdin=subprocess.DEVNULL, env={**os.environ, "RUST_LOG": "error"})
        try:
            (folder / "hooks.py").write_text(HOOKS)
            (folder / "schemathesis.toml").write_text(SETTINGS)
            run = subprocess.run(
                [str(pathlib.Path(sys.executable).with_name("schemathesis")), "--config-file", "schemathesis.toml", "run",
                 str(root / "openapi.yaml"), "--url", address, "-H", f"Authorization: Bearer {key}", "--seed", "1",
                 "--phases", "examples,coverage,fuzzing,stateful", "--continue-on-failure", "--no-color",
                 "--generation-deterministic", "--warnings", "off", "--report", "json,har", "--report-json-path", "report.json",
                 "--report-har-path", "calls.har", *sys.argv[1:]],
                cwd=folder, env={**os.environ, "SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": name, "ADDRESS": address, "KEY": key,
                     "SLICE": str(next((pathlib.Path(os.environ["VASCULUM_SCAN"]) / "dicom").iterdir()))}, text=True,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=240,
            )
            if run.returncode != 0:
                sys.exit(run.stdout)
            judge(folder, address)
        finally:
            process.terminate()
            process.wait(timeout=20)


def judge(folder, address):
    report = json.loads((folder / "report.json").read_text())
    operations = report["operations"]
    assert operations["tested"] == operations["total"] >= 30, operations
    assert all(phase["status"] == "success" for phase in report["phases"].values()), report["phases"]
    # Reached means more than sent: where every answer was a refusal, nothing but the door was tested.
    answers = {}
    for call in json.loads((folder / "calls.har").read_text())["log"]["entries"]:
        path = "/" + call["request"]["url"].split("?")[0].split("/", 3)[3]
        for place in PLACES:
            if re.fullmatch(place[1], path) and place[0] == call["request"]["method"]:
                answers.setdefault(place, set()).add(call["response"]["status"])
    for place in PLACES:
        done = {status for status in answers.get(place, ()) if status < 300}
        assert done, f"{place} was never done: {sorted(answers.get(place, ()))}"
    with urllib.request.urlopen(address + "/healthz", timeout=5) as answer:
        assert answer.status == 200
    sent = report["test_cases"]["generated"]
    print(f"schemathesis: {sent} calls to {operations['tested']} operations in four phases, 0 failures")


main()
