"""What tests of the running binary share: starting it, following jobs, and a PostgreSQL of their own."""

import functools
import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time

import requests

ROOT = pathlib.Path(os.environ["VASCULUM_ROOT"])
BINARY = os.environ["VASCULUM_BIN"]


@functools.cache
def slices():
    """A small scan, whose job takes a second: names and bytes."""
    with tempfile.TemporaryDirectory() as folder:
        asked = ["phantom", "tube", "--distractors", "0", "--size", "64", "--slices", "24", "--seed", "1", "--out", folder]
        subprocess.run([BINARY, *asked], check=True, stdout=subprocess.DEVNULL, timeout=60)
        return [(file.name, file.read_bytes()) for file in sorted(pathlib.Path(folder, "dicom").glob("*.dcm"))]


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Service:
    """`vasculum serve` on a folder, with a session that carries its admin key."""

    def __init__(self, data, *arguments, key=None, env=None):
        self.process = subprocess.Popen(
            [BINARY, "serve", "--listen", "127.0.0.1:0", "--data-dir", str(data), *arguments],
            stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, stderr=open(f"{data}.log", "a"), text=True,
            env={**os.environ, "RUST_LOG": "warn", **(env or {})},
        )
        self.address, self.key = None, key
        for line in self.process.stdout:
            self.address = self.address or (line.split()[-1] if line.startswith("listening on ") else None)
            found = re.search(r"vsk_[0-9a-f]+", line)
            self.key = self.key or (found and found.group())
            if self.address and self.key:
                break
        else:
            sys.exit("the service did not start: " + pathlib.Path(f"{data}.log").read_text())
        self.session = requests.Session()
        self.session.headers["Authorization"] = f"Bearer {self.key}"

    def get(self, path, **more):
        return self.session.get(self.address + path, timeout=90, **more)

    def submit(self, **more):
        """Sends the small scan; the answer."""
        files = [("input", slice) for slice in slices()]
        return self.session.post(self.address + "/v1/jobs", files=files, timeout=90, **more)

    def ended(self, job):
        for _ in range(20):
            told = self.get(f"{job}?wait=30").json()
            if told["state"] in ("succeeded", "failed", "cancelled"):
                return told
        sys.exit(f"the job does not end: {told}")

    def stop(self, kill=False):
        self.process.send_signal(signal.SIGKILL if kill else signal.SIGTERM)
        self.process.wait(timeout=30)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.stop()


class Postgres:
    """Debian's server in a temporary folder, on a socket, run by a user that is not root; a role that is no superuser."""

    def __init__(self):
        versions = sorted(pathlib.Path("/usr/lib/postgresql").glob("*/bin/initdb"))
        assert versions, "PostgreSQL is not installed"
        self.bin = versions[-1].parent
        self.folder = tempfile.mkdtemp(prefix="vpg-", dir="/tmp")
        if os.getuid() == 0:
            subprocess.run(["chown", "postgres", self.folder], check=True)
        self.run("initdb", "-D", f"{self.folder}/data", "-U", "postgres", "-A", "trust", "--locale=C", "-E", "UTF8")
        self.start()
        self.sql("CREATE ROLE vasculum LOGIN")
        self.names = 0

    def run(self, program, *arguments):
        as_user = ["runuser", "-u", "postgres", "--"] if os.getuid() == 0 else []
        done = subprocess.run([*as_user, str(self.bin / program), *arguments], cwd=self.folder, timeout=60,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert done.returncode == 0, f"{program}: {done.stdout}"
        return done.stdout

    def start(self):
        options = f"-k {self.folder} -c listen_addresses= -c max_connections=100"
        self.run("pg_ctl", "-D", f"{self.folder}/data", "-w", "-l", f"{self.folder}/log", "-o", options, "start")

    def halt(self):
        self.run("pg_ctl", "-D", f"{self.folder}/data", "-m", "fast", "stop")

    def sql(self, text):
        return self.run("psql", "-X", "-q", "-t", "-A", "-U", "postgres", "-h", self.folder, "-d", "postgres", "-c", text)

    def database(self):
        """The address of a new, empty database."""
        self.names += 1
        self.sql(f"CREATE DATABASE v{self.names} OWNER vasculum")
        return f"postgres://vasculum@localhost/v{self.names}?host={self.folder}"

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.run("pg_ctl", "-D", f"{self.folder}/data", "-m", "immediate", "stop")
        subprocess.run(["rm", "-rf", self.folder], check=True)


def until(what, seconds=20):
    """Waits until `what` gives something true, and gives it back."""
    begun = time.time()
    while not (found := what()):
        assert time.time() - begun < seconds, f"not within {seconds} s: {what}"
        time.sleep(0.1)
    return found
