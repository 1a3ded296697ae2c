"""deploy/backup.sh on a service at work, then deploy/restore.sh onto an empty folder (and an empty database).

Every job that was there at the backup is there again with every artefact, byte for byte; those that ran or waited end; the
audit's chain is whole; a folder that is not empty is refused. On SQLite and on PostgreSQL, each with a local store.
"""

import hashlib
import os
import pathlib
import subprocess
import sys
import tempfile

from support import BINARY, ROOT, Postgres, Service, until


def script(name, *arguments, url=None, **more):
    env = {**os.environ, "PATH": f"{pathlib.Path(BINARY).parent}:{os.environ['PATH']}"}
    env.pop("VASCULUM_DATABASE_URL", None)
    if url:
        env["VASCULUM_DATABASE_URL"] = url
    return subprocess.run(["sh", str(ROOT / "deploy" / name), *map(str, arguments)], env=env, text=True, timeout=120,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **more)


def artefacts(service, job):
    items = service.get(f"/v1/jobs/{job}/artefacts").json()["items"]
    for item in items:
        answer = service.get(item["href"])
        assert "sha256:" + hashlib.sha256(answer.content).hexdigest() == item["digest"], item
    return {item["name"]: item["digest"] for item in items}


def round_trip(folder, first_url, second_url):
    arguments = lambda data, url: ["--database-url", url, "--store-url", f"file:{data}/store"] if url else []
    data, backup, again = folder / "data", folder / "backup", folder / "again"
    with Service(data, *arguments(data, first_url)) as service:
        ended = service.submit().headers["Location"]
        assert service.ended(ended)["state"] == "succeeded"
        made = artefacts(service, ended.split("/")[-1])
        waiting = [service.submit().headers["Location"] for _ in range(2)]
        until(lambda: any(service.get(job).json()["state"] == "running" for job in waiting))
        copied = script("backup.sh", data, backup, url=first_url)
        assert copied.returncode == 0, copied.stdout
        # What comes after the backup is lost with the machine.
        lost = service.submit().headers["Location"]
        service.stop(kill=True)
        key = service.key
    refused = script("restore.sh", backup, data, url=second_url)
    assert refused.returncode == 2 and "not empty" in refused.stdout, refused.stdout
    restored = script("restore.sh", backup, again, url=second_url)
    assert restored.returncode == 0 and "the audit is whole" in restored.stdout, restored.stdout
    with Service(again, *arguments(again, second_url), key=key) as service:
        assert service.get(ended).json()["state"] == "succeeded"
        assert artefacts(service, ended.split("/")[-1]) == made
        for job in waiting:
            assert service.ended(job)["state"] == "succeeded"
            assert len(artefacts(service, job.split("/")[-1])) == len(made)
        assert service.get(lost).status_code == 404
        assert len(service.get("/v1/jobs").json()["items"]) == 3
    return len(made)


def main():
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        (folder / "sqlite").mkdir()
        (folder / "postgres").mkdir()
        count = round_trip(folder / "sqlite", None, None)
        with Postgres() as server:
            round_trip(folder / "postgres", server.database(), server.database())
    print(f"restore: 3 jobs and {count} artefacts each come back on SQLite and on PostgreSQL; what ran ends")


main()
