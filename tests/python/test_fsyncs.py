"""A loss of power after any fsync of the database: SQLite opens, is whole, and holds every job that was acknowledged.

strace writes down what the server writes, syncs and answers, in one order. After each fsync the files are laid out anew as a
disk would hold them that keeps only what was synced (and once more with half of the writes that came after), and opened by
Python's own SQLite.
"""

import json
import os
import pathlib
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading

import requests

from support import BINARY

JOBS, AT_ONCE = 80, 8
PLAN = json.dumps({"geometry": {"pixel_spacing_mm": [0.5, 0.5], "slice_spacing_mm": 2.0}})
SLICE = b"P2\n8 8\n255\n" + b"10 " * 64
CALLS = "pwrite64,write,writev,sendto,sendmsg,fsync,fdatasync,ftruncate,unlink"
HEX = re.compile(r"\"((?:\\x[0-9a-f]{2})*)\"")


def plain(text):
    return bytes.fromhex(text.replace("\\x", ""))


def traced(folder):
    """Sends jobs to a server under strace; the lines of the trace."""
    command = ["strace", "-f", "-y", "-xx", "-s", "200000", "-e", f"trace={CALLS}", "-o", str(folder / "trace"),
               BINARY, "serve", "--no-auth", "--workers", "0", "--listen", "127.0.0.1:0", "--data-dir", str(folder / "data")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    address = next(line.split()[-1] for line in process.stdout if line.startswith("listening on "))

    def send():
        for _ in range(JOBS // AT_ONCE):
            files = [("plan", (None, PLAN)), *[("input", (f"{n}.pgm", SLICE)) for n in range(3)]]
            assert requests.post(address + "/v1/jobs", files=files, timeout=60).status_code == 202

    senders = [threading.Thread(target=send) for _ in range(AT_ONCE)]
    [sender.start() for sender in senders]
    [sender.join() for sender in senders]
    [server] = pathlib.Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    os.kill(int(server), signal.SIGKILL)
    process.wait(timeout=30)
    return (folder / "trace").read_text(errors="replace").splitlines()


class Disk:
    """Files as the server wrote them, and as they were synced."""

    def __init__(self):
        self.now, self.synced, self.since = {}, {}, []

    def write(self, name, data, at):
        self.since.append((name, data, at))
        self.now[name] = put(self.now.get(name, b""), data, at)

    def sync(self, name):
        self.synced[name] = self.now.get(name, b"")
        self.since = [write for write in self.since if write[0] != name]

    def torn(self):
        """The synced files with the first half of the writes that came after."""
        files = dict(self.synced)
        for name, data, at in self.since[: len(self.since) // 2]:
            files[name] = put(files.get(name, b""), data, at)
        return files


def put(content, data, at):
    content = content.ljust(at, b"\0")
    return content[:at] + data + content[at + len(data):]


def opened(files, acknowledged, scratch):
    """Opens the files as SQLite finds them after the power is back."""
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    for name, content in files.items():
        (scratch / name).write_bytes(content)
    database = sqlite3.connect(scratch / "vasculum.sqlite")
    assert database.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
    if acknowledged:
        there = {row[0] for row in database.execute("SELECT id FROM job")}
        assert acknowledged <= there, f"acknowledged and lost: {acknowledged - there}"
    database.close()


def replayed(lines, scratch):
    disk, acknowledged, syncs, pending = Disk(), set(), 0, {}
    for line in lines:
        process, _, call = line.partition(" ")
        call = call.strip()
        # A call that another one interrupted comes in two lines: it counts when it returns.
        if call.endswith("<unfinished ...>"):
            pending[process] = call.removesuffix("<unfinished ...>")
            # A write may have reached the file already; an answer has left when it is on its way.
            if not call.startswith(("write", "send")):
                continue
            call = pending.pop(process)
        elif call.startswith("<... ") and "resumed>" in call:
            if process not in pending:
                continue
            call = pending.pop(process) + call.split("resumed>", 1)[1]
        name, _, rest = call.partition("(")
        if name in ("write", "writev", "sendto", "sendmsg"):
            text = b"".join(plain(found) for found in HEX.findall(rest))
            if text.startswith(b"HTTP/1.1 202"):
                acknowledged.add(re.search(rb'"id":"([0-9a-f-]{36})"', text).group(1).decode())
            continue
        where = re.match(r"\d+<((?:\\x[0-9a-f]{2})+)>", rest)
        file = pathlib.Path(plain(where.group(1)).decode()).name if where else ""
        if name == "unlink" and (gone := HEX.search(rest)):
            file = pathlib.Path(plain(gone.group(1)).decode()).name
            disk.now.pop(file, None), disk.synced.pop(file, None)
        if not file.startswith("vasculum.sqlite") or file.endswith("-shm"):
            continue
        if name == "pwrite64":
            data = plain(HEX.search(rest).group(1))
            size, at = re.search(r"\", (\d+), (\d+) ?\)", rest).groups()
            assert len(data) == int(size), "strace cut a write short"
            disk.write(file, data, int(at))
        elif name == "ftruncate":
            size = int(re.search(r">, (\d+) ?\)", rest).group(1))
            disk.now[file] = disk.now.get(file, b"")[:size].ljust(size, b"\0")
        elif name in ("fsync", "fdatasync"):
            disk.sync(file)
            syncs += 1
            opened(disk.synced, acknowledged, scratch)
            opened(disk.torn(), acknowledged, scratch)
    return syncs, acknowledged


def main():
    if not shutil.which("strace"):
        sys.exit("strace is not installed")
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        probe = subprocess.run(["strace", "-o", "/dev/null", "true"], capture_output=True, text=True)
        if probe.returncode != 0:
            print(f"skipped: strace may not look into a process here: {probe.stderr.strip()}")
            return
        syncs, acknowledged = replayed(traced(folder), folder / "scratch")
    assert len(acknowledged) == JOBS, f"{len(acknowledged)} answers of {JOBS} in the trace"
    assert syncs > JOBS // 8, syncs
    print(f"fsyncs: {syncs} prefixes of the database opened whole, each with every job that was acknowledged ({JOBS} at the end)")


main()
