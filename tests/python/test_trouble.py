"""Full disks, a database that is away, and an S3 in trouble: said with 507 or 503 and Retry-After, nothing torn, and
everything goes on by itself afterwards.

The full disks are small tmpfs mounts (root only; said where that is not possible), the database is a PostgreSQL of the
test's own that is stopped and started, S3 is s3s-fs behind a proxy that answers one request in ten with 500, with 503, or
not at all. TROUBLE_SECONDS makes the time without a database longer (60 in the long run).
"""

import hashlib
import http.client
import http.server
import os
import pathlib
import random
import subprocess
import sys
import tempfile
import threading
import time

import boto3
import requests
from botocore.config import Config

from support import Postgres, Service, free_port, until

AWAY = float(os.environ.get("TROUBLE_SECONDS", "6"))


class SmallDisk:
    """A tmpfs, and a file that takes what is left of it."""

    def __init__(self, place, mib):
        self.place = place
        place.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={mib}m", "tmpfs", str(place)], check=True)

    def fill(self):
        with open(self.place / "filler", "wb", buffering=0) as filler:
            size = 1 << 20
            while size:
                try:
                    filler.write(b"\0" * size)
                except OSError:
                    size //= 2

    def empty(self):
        (self.place / "filler").unlink()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        subprocess.run(["umount", "--lazy", str(self.place)], check=True)


def refused(answer, status, code):
    assert answer.status_code == status, f"{answer.status_code} {answer.text[:300]}"
    assert answer.headers["content-type"] == "application/problem+json"
    assert int(answer.headers["retry-after"]) > 0
    assert answer.json()["code"] == code, answer.text


def works(service):
    """A scan that is sent now becomes a result whose artefacts are all there."""
    sent = service.submit()
    assert sent.status_code == 202, sent.text
    job = sent.headers["Location"]
    assert service.ended(job)["state"] == "succeeded"
    for item in service.get(f"{job}/artefacts").json()["items"]:
        assert len(service.get(item["href"]).content) == item["bytes"]
    return job


def store_full(folder):
    with SmallDisk(folder / "small", 64) as disk:
        with Service(folder / "data", "--store-url", f"file:{disk.place}/store") as service:
            first = works(service)
            disk.fill()
            for _ in range(3):
                refused(service.submit(), 507, "storage.full")
            assert service.get("/readyz").json()["code"] == "not_ready"
            assert [job["id"] for job in service.get("/v1/jobs").json()["items"]] == [first.split("/")[-1]]
            stored = {path.name for path in (disk.place / "store/jobs").iterdir()}
            assert stored == {first.split("/")[-1]}, "a refused scan left something"
            disk.empty()
            works(service)
            assert service.get(f"{first}/result").json()["schema"] == "vasculum/result/1"


def database_full(folder):
    with SmallDisk(folder / "small", 16) as disk:
        arguments = ["--database-url", f"sqlite:{disk.place}/vasculum.sqlite", "--store-url", f"file:{folder}/store"]
        with Service(folder / "data", *arguments) as service:
            first = works(service)
            running = service.submit().headers["Location"]
            until(lambda: service.get(running).json()["state"] == "running")
            disk.fill()
            # The log of the database may hold pages for a few more; then it is full, and says so.
            answers = [service.submit() for _ in range(40)]
            refused(answers[-1], 507, "storage.full")
            kept = {answer.headers["Location"] for answer in answers if answer.status_code == 202}
            assert service.get(first).json()["state"] == "succeeded", "reading goes on"
            time.sleep(3)
            disk.empty()
            for job in [running, *kept]:
                assert service.ended(job)["state"] == "succeeded"
            works(service)
            listed = {"/v1/jobs/" + job["id"] for job in service.get("/v1/jobs?limit=200").json()["items"]}
            assert {first, running, *kept} <= listed and len(listed) == len(kept) + 3, "a refused job is none"
            service.stop(kill=True)
        check = subprocess.run(["python3", "-c", CHECK, f"{disk.place}/vasculum.sqlite"], capture_output=True, text=True)
        assert check.stdout.strip() == "ok", check.stdout + check.stderr


CHECK = "import sqlite3, sys; print(sqlite3.connect(sys.argv[1]).execute('PRAGMA integrity_check').fetchone()[0])"


def database_away(folder):
    with Postgres() as server:
        arguments = ["--database-url", server.database(), "--store-url", f"file:{folder}/store"]
        with Service(folder / "data", *arguments) as service:
            works(service)
            running = service.submit().headers["Location"]
            until(lambda: service.get(running).json()["state"] == "running")
            server.halt()
            begun = time.time()
            while time.time() - begun < AWAY:
                refused(service.submit(), 503, "database.away")
                refused(service.get("/v1/jobs"), 503, "database.away")
                ready = service.get("/readyz")
                assert ready.status_code == 503 and ready.json()["errors"][0]["code"] == "ready.database", ready.text
                assert service.get("/healthz").status_code == 200
                time.sleep(0.5)
            server.start()
            until(lambda: service.get("/readyz").status_code == 200)
            told = service.ended(running)
            assert told["state"] == "succeeded" and told["attempt"] <= 2, told
            works(service)
            assert len(service.get("/v1/jobs").json()["items"]) == 3


class Trouble(http.server.BaseHTTPRequestHandler):
    """Passes a request on, or answers in its place: 500, 503, the end of the connection, or nothing at all."""

    protocol_version = "HTTP/1.1"
    dice = random.Random(7)
    lock = threading.Lock()
    target = rate = 0
    faults = {"500": 0, "503": 0, "closed": 0, "silent": 0}
    # Requests that will find nobody who answers, and what lets them go.
    silent = 0
    over = threading.Event()

    def pass_on(self):
        with self.lock:
            # one that never answers well answers at once: the silent one is tried by itself
            kinds = [kind for kind in self.faults if self.rate < 1 or kind != "silent"]
            fault = self.dice.choice(kinds) if self.dice.random() < self.rate else None
            if fault:
                self.faults[fault] += 1
            is_silent = Trouble.silent > 0 or fault == "silent"
            Trouble.silent -= Trouble.silent > 0
        if is_silent:
            self.over.wait(120)
            self.close_connection = True
            return
        body = self.rfile.read(int(self.headers.get("content-length") or 0))
        if fault == "closed":
            self.close_connection = True
            return
        if fault:
            self.answer(int(fault), {"content-type": "application/xml"}, b"<Error><Code>InternalError</Code></Error>")
            return
        peer = http.client.HTTPConnection("127.0.0.1", self.target, timeout=30)
        peer.putrequest(self.command, self.path, skip_host=True, skip_accept_encoding=True)
        for name, value in self.headers.items():
            peer.putheader(name, value)
        peer.endheaders(body)
        told = peer.getresponse()
        content = told.read()
        keep = {k: v for k, v in told.getheaders() if k.lower() not in ("transfer-encoding", "connection", "content-length")}
        if self.command == "HEAD":
            keep["content-length"] = told.getheader("content-length") or "0"
        self.answer(told.status, keep, content)
        peer.close()

    def answer(self, status, headers, content):
        self.send_response_only(status)
        for name, value in headers.items():
            self.send_header(name, value)
        if "content-length" not in headers:
            self.send_header("content-length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    do_GET = do_PUT = do_HEAD = do_DELETE = do_POST = pass_on

    def log_message(self, *_):
        pass


def s3_in_trouble(folder):
    (folder / "bucket/scans").mkdir(parents=True)
    Trouble.target = free_port()
    s3 = subprocess.Popen(
        [os.environ["VASCULUM_S3S"], "--host", "127.0.0.1", "--port", str(Trouble.target), "--access-key", "key", "--secret-key", "secret",
         str(folder / "bucket")], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    proxy = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Trouble)
    proxy.daemon_threads = True
    threading.Thread(target=proxy.serve_forever, daemon=True).start()
    env = {"VASCULUM_S3_ENDPOINT": f"http://127.0.0.1:{proxy.server_port}", "VASCULUM_S3_REGION": "us-east-1",
           "VASCULUM_S3_ACCESS_KEY_ID": "key", "VASCULUM_S3_SECRET_ACCESS_KEY": "secret"}
    try:
        with Service(folder / "data", "--store-url", "s3://scans/ward", env=env) as service:
            until(lambda: service.get("/readyz").status_code == 200)
            others_read(service, works(service))
            Trouble.rate = 0.1
            jobs = [works(service) for _ in range(2)]
            for job in jobs:
                assert requests.delete(service.address + job, headers=service.session.headers, timeout=60).status_code == 204
            Trouble.rate = 1.0
            # A store that never answers well is said to be away.
            begun = time.time()
            refused(service.submit(), 503, "store.away")
            assert time.time() - begun < 45
            Trouble.rate = 0
            works(service)
            s3_is_silent(service)
    finally:
        s3.kill()
        s3.wait()
        proxy.shutdown()
    assert all(count > 2 for kind, count in Trouble.faults.items() if kind != "silent"), Trouble.faults
    return sum(Trouble.faults.values())


def others_read(service, job):
    """boto3 finds the artefacts in the bucket, each with the bytes and the digest that the API tells."""
    client = boto3.client(
        "s3", endpoint_url=f"http://127.0.0.1:{Trouble.target}", region_name="us-east-1", aws_access_key_id="key",
        aws_secret_access_key="secret", config=Config(s3={"addressing_style": "path"}))
    prefix = f"ward/jobs/{job.split('/')[-1]}/artefacts/1/"
    found = {item["Key"].removeprefix(prefix): item["Size"] for item in client.list_objects_v2(Bucket="scans", Prefix=prefix)["Contents"]}
    told = service.get(f"{job}/artefacts").json()["items"]
    assert found == {item["name"]: item["bytes"] for item in told}
    for item in told:
        read = client.get_object(Bucket="scans", Key=prefix + item["name"])["Body"].read()
        assert "sha256:" + hashlib.sha256(read).hexdigest() == item["digest"], item["name"]


def s3_is_silent(service):
    """A store that takes connections and says nothing: asked again elsewhere, and nobody waits for ever."""
    Trouble.silent = 1
    begun = time.time()
    works(service)
    assert Trouble.silent == 0 and time.time() - begun < 60
    running, cancelled = service.submit().headers["Location"], service.submit().headers["Location"]
    until(lambda: service.get(running).json()["state"] == "running")
    Trouble.silent = 1_000_000
    begun = time.time()
    assert service.get("/readyz").json()["code"] == "not_ready"
    assert service.get(running).status_code == 200 and time.time() - begun < 8
    refused(service.submit(), 503, "store.away")
    assert time.time() - begun < 50
    # Its scan cannot be read, or its result not be stored: it can be cancelled all the same.
    assert service.session.post(f"{service.address}{cancelled}/cancel", timeout=10).ok
    until(lambda: service.get(cancelled).json()["state"] == "cancelled")
    Trouble.silent = 0
    Trouble.over.set()
    told = service.ended(running)
    assert (told["state"], told["attempt"]) == ("succeeded", 1), told
    works(service)


def main():
    done = []
    with tempfile.TemporaryDirectory() as name:
        places = {}
        for place in ("store", "database", "away", "s3"):
            places[place] = pathlib.Path(name) / place
            places[place].mkdir()
        small = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", "/mnt"], capture_output=True)
        if small.returncode == 0:
            subprocess.run(["umount", "/mnt"], check=True)
            store_full(places["store"])
            database_full(places["database"])
            done.append("a full disk of the store and of the database")
        else:
            print("skipped: the full disks, which need the right to mount a tmpfs")
        database_away(places["away"])
        done.append(f"{AWAY:.0f} s without PostgreSQL")
        faults = s3_in_trouble(places["s3"])
        done.append(f"{faults} faults of S3")
    print("trouble: " + ", ".join(done) + ": said with Retry-After, nothing lost, all goes on")


main()
