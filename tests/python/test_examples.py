"""Every example of openapi.yaml is sent to the binary, as it stands there: parameters, bodies, media types.

Ids, keys and the host of an example are replaced by those that this test has; a file's bytes, which a document cannot
hold, by a slice. The answer must have the status that the example names, fit the schema, and have the members that the
written answer has. The written answers must fit the schemas too.
"""

import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import time

import jsonschema
import requests
import yaml
from shared.serving import serve



class Core(yaml.SafeLoader):
    """The core schema of YAML 1.2, in which a time is a text."""


Core.yaml_implicit_resolvers = {
    first: [pair for pair in pairs if not pair[0].endswith(":timestamp")]
    for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
document = yaml.load((pathlib.Path(os.environ["VASCULUM_ROOT"]) / "openapi.yaml").read_text(), Core)
scan = pathlib.Path(os.environ["VASCULUM_SCAN"])
slices = sorted((scan / "dicom").glob("*.dcm"))
STUDY = re.search(rb"\x20\x00\x0d\x00UI..([0-9.]+)", slices[0].read_bytes()).group(1).decode()


def fits(value, schema):
    jsonschema.Draft202012Validator({**schema, "components": document["components"]}).validate(value)


class Bench:
    def __init__(self, address, key):
        self.address, self.session = address, requests.Session()
        self.session.headers["Authorization"] = "Bearer " + key
        self.key, self.sent = key, set()

    def send(self, operation_id, media=None, accept=None, **live):
        """Sends an operation's example; `live` replaces parameters, a body's members, or the whole `body`."""
        method, path, operation = OPERATIONS[operation_id]
        query, headers = {}, {}
        for parameter in operation.get("parameters", []):
            name = parameter["name"]
            if "example" not in parameter and name not in live:
                assert not parameter.get("required"), f"{operation_id}: {name} has no example"
                continue
            value = live.pop(name, parameter.get("example"))
            if parameter["in"] == "path":
                path = path.replace("{" + name + "}", str(value))
            else:
                text = ",".join(map(str, value)) if isinstance(value, list) else str(value)
                {"query": query, "header": headers}[parameter["in"]][name] = text
        body = {}
        if media:
            example = operation["requestBody"]["content"][media]["example"]
            body, more = self.body(media, example, live)
            headers.update(more)
        if accept:
            headers["Accept"] = accept
        answer = self.session.request(method, self.address + path, params=query, headers=headers, timeout=90, **body)
        self.sent.add((operation_id, media))
        self.judge(operation_id, operation, answer)
        return answer

    def body(self, media, example, live):
        if media == "application/json":
            return {"json": {**example, **live}}, {}
        if media == "multipart/form-data":
            parts = [("input", (f"slice-{n}.pgm", text)) for n, text in enumerate(example["input"])]
            return {"files": [("plan", (None, json.dumps(example["plan"]))), *parts]}, {}
        if media == "multipart/related":
            head, tail = example.split("(the bytes of a DICOM file)")
            data = head.encode() + slices[0].read_bytes() + tail.encode()
            return {"data": data}, {"Content-Type": 'multipart/related; type="application/dicom"; boundary=frontier'}
        return {"data": example}, {"Content-Type": media}

    def judge(self, operation_id, operation, answer):
        what = f"{operation_id}: {answer.status_code} {answer.text[:300]}"
        told = operation["responses"].get(str(answer.status_code))
        assert told and answer.status_code < 300, what
        kind = answer.headers.get("Content-Type", "").split(";")[0]
        content = told.get("content", {}).get(kind)
        if kind.endswith("json") and content:
            fits(answer.json(), content["schema"])
            if "example" in content:
                written, real = set(content["example"]), set(answer.json())
                assert written <= real, f"{what}: the written answer has {written - real} more"


OPERATIONS = {
    operation["operationId"]: (method.upper(), path, operation)
    for path, item in document["paths"].items() for method, operation in item.items()
}


def written():
    """The written answers and bodies against their schemas."""
    count = 0
    for method, path, operation in OPERATIONS.values():
        contents = [operation.get("requestBody", {}).get("content", {})]
        contents += [response.get("content", {}) for response in operation["responses"].values()]
        for content in contents:
            for kind, told in content.items():
                if "example" in told and kind.endswith("json"):
                    fits(told["example"], told["schema"])
                    count += 1
        for parameter in operation.get("parameters", []):
            if "example" in parameter:
                fits(parameter["example"], parameter["schema"])
                count += 1
    return count


def ended(bench, job):
    for _ in range(10):
        told = bench.send("read_job", id=job, wait=60).json()
        if told["state"] in ("succeeded", "failed", "cancelled"):
            return told
    sys.exit(f"the job does not end: {told}")


def everything(bench):
    for operation in ("healthz", "metrics", "readyz", "version", "read_stats"):
        bench.send(operation)
    # A whole scan, so that there is a result; the example's own three slices hold no vessel, so that there is a failure.
    files = [("input", (file.name, file.read_bytes())) for file in slices]
    whole = bench.session.post(bench.address + "/v1/jobs", files=files, timeout=60).json()["id"]
    failing = bench.send("create_job", media="multipart/form-data").json()["id"]
    waiting = bench.send("create_job", media="multipart/form-data", **{"Idempotency-Key": "another"}).json()["id"]
    assert bench.send("prioritise_job", id=waiting).json()["priority"] == 10
    assert bench.send("cancel_job", id=waiting).json()["state"] == "cancelled"
    bench.send("cancel_jobs")
    assert ended(bench, whole)["state"] == "succeeded"
    assert ended(bench, failing)["state"] == "failed"
    bench.send("retry_job", id=failing)
    for operation in ("list_artefacts", "read_artefact", "read_result"):
        bench.send(operation, id=whole)
    table = bench.send("read_cohort").json()
    assert table["jobs"] == 1 and table["rows"][0]["job"] == whole
    series = bench.send("create_jobs", media="application/json", id=whole).json()["items"]
    assert [job["parent"] for job in series] == [whole, whole]
    # Whether they run still, or have ended already, which took a moment or two: they are of no use here.
    for job in series:
        bench.send("erase_job", id=job["id"])
    bench.send("follow_job", id=whole, accept="application/json")
    stream = bench.send("follow_job", id=whole, accept="text/event-stream").text
    assert "event: state" in stream
    assert bench.send("list_jobs").json()["items"][0]["id"] == whole
    upload = bench.send("create_upload").headers["Location"].split("/")[-1]
    bench.send("upload_abilities")
    bench.send("append_upload", media="application/offset+octet-stream", id=upload)
    assert bench.send("read_upload", id=upload).headers["Upload-Offset"] == "11"
    bench.send("delete_upload", id=upload)
    image = scan / "scan.mha"
    sized = {"Upload-Length": str(image.stat().st_size)}
    sealed = bench.send("create_upload", **sized).headers["Location"].split("/")[-1]
    headers = {"Tus-Resumable": "1.0.0", "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    address = f"{bench.address}/v1/uploads/{sealed}"
    assert bench.session.patch(address, data=image.read_bytes(), headers=headers, timeout=60).status_code == 204
    named = bench.send("create_job", media="application/json", upload=sealed, **{"Idempotency-Key": "sealed"}).json()["id"]
    bench.send("store_instances", media="multipart/related")
    bench.send("store_study", media="multipart/related", study=STUDY)
    bench.send("begin_session", media="application/json", key=bench.key)
    bench.send("end_session")
    hook = bench.send("create_webhook", media="application/json", url="https://127.0.0.1:9/told").json()["id"]
    bench.send("list_webhooks")
    bench.send("delete_webhook", id=hook)
    bench.send("list_workers")
    bench.send("read_session")
    bench.send("read_plan", id=whole)
    bench.send("create_link", id=whole)
    bench.send("create_key", media="application/json")
    keys = bench.send("list_keys").json()["items"]
    bench.send("revoke_key", id=next(key["id"] for key in keys if key["label"] == "ward 3"))
    bench.send("change_tenant", media="application/json")
    bench.send("read_tenant")
    bench.send("read_audit")
    for job in (named, whole):
        bench.send("erase_job", id=job)


def main():
    count = written()
    with tempfile.TemporaryDirectory() as folder:
        process, address, key = serve(folder, "--webhook-host", "127.0.0.1", stderr=subprocess.DEVNULL)
        try:
            bench = Bench(address, key)
            everything(bench)
        finally:
            process.terminate()
            process.wait(timeout=30)
    wanted = {(name, media) for name, (_, _, operation) in OPERATIONS.items()
              for media in operation.get("requestBody", {}).get("content", {None: None})}
    assert bench.sent == wanted, f"not sent: {wanted - bench.sent}"
    print(f"{len(OPERATIONS)} operations: every example sent as written, {count} written values fit their schemas")


main()
