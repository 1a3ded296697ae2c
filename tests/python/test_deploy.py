"""deploy/ is read by the tools that would run it: Prometheus, Kubernetes' schemas, podman-compose, nginx.

The dashboard's queries are parsed by Prometheus too, and name metrics that the binary has.
"""

import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import urllib.request

import kubernetes_validate
import yaml

root = pathlib.Path(os.environ["VASCULUM_ROOT"]) if "VASCULUM_ROOT" in os.environ else pathlib.Path(__file__).parents[2]
deploy = root / "deploy"


def run(*command, **more):
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=60, **more)
    assert done.returncode == 0, f"{command}: {done.stdout}"
    return done.stdout


def metrics():
    """Names that a binary without jobs shows after one call."""
    with tempfile.TemporaryDirectory() as data:
        service = subprocess.Popen(
            [os.environ["VASCULUM_BIN"], "serve", "--no-auth", "--listen", "127.0.0.1:0", "--data-dir", data],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )
        try:
            address = next(line.split()[-1] for line in service.stdout if line.startswith("listening on "))
            urllib.request.urlopen(address + "/version", timeout=5).read()
            return set(re.findall(r"^(\w+)", urllib.request.urlopen(address + "/metrics", timeout=5).read().decode(), re.M))
        finally:
            service.terminate()
            service.wait(timeout=20)


def prometheus():
    run("promtool", "check", "rules", str(deploy / "rules.yml"))
    run("promtool", "test", "rules", str(deploy / "rules_test.yml"))
    board = json.loads((deploy / "grafana.json").read_text())
    queries = [target["expr"] for panel in board["panels"] for target in panel["targets"]]
    plain = [q.replace("$__rate_interval", "5m").replace("$job", ".+") for q in queries]
    rules = {"groups": [{"name": "panels", "rules": [{"record": f"panel:{i}", "expr": q} for i, q in enumerate(plain)]}]}
    with tempfile.NamedTemporaryFile("w", suffix=".yml") as file:
        yaml.safe_dump(rules, file)
        file.flush()
        run("promtool", "check", "rules", file.name)
    alerts = [rule["expr"] for group in yaml.safe_load((deploy / "rules.yml").read_text())["groups"] for rule in group["rules"]]
    named = {name for query in plain + alerts for name in re.findall(r"vasculum_\w+", query)}
    assert named <= metrics(), f"no such metrics: {named - metrics()}"
    return len(plain) + len(alerts)


def kubernetes():
    documents = list(yaml.safe_load_all((deploy / "kubernetes/vasculum.yaml").read_text()))
    for document in documents:
        kubernetes_validate.validate(document, "1.32", strict=True)
    return len(documents)


def compose():
    podman = str(pathlib.Path(sys.executable).with_name("podman-compose"))
    secrets = {"POSTGRES_PASSWORD": "a", "S3_ACCESS_KEY": "b", "S3_SECRET_KEY": "c"}
    services = 0
    # podman-compose asks podman for its version before it reads anything; nothing is started here.
    stub = tempfile.TemporaryDirectory()
    program = pathlib.Path(stub.name) / "podman"
    program.write_text("#!/bin/sh\necho podman version 5.0.0\n")
    program.chmod(0o755)
    secrets["PATH"] = f"{os.environ['PATH']}:{stub.name}"
    for file in ("one.yaml", "many.yaml"):
        said = run(podman, "-f", str(deploy / "compose" / file), "config", env={**os.environ, **secrets})
        services += len(yaml.safe_load(said[said.index("services:"):] if "services:" in said else said)["services"])
    run("sh", "-n", str(deploy / "compose/postgres.sh"))
    run("sh", "-n", str(deploy / "backup.sh"))
    with tempfile.TemporaryDirectory() as folder:
        text = (deploy / "compose/nginx.conf").read_text()
        conf = pathlib.Path(folder) / "nginx.conf"
        # The names of the servers are known inside only.
        conf.write_text(f"pid {folder}/pid; error_log stderr;\n" + re.sub(r"api-\d:", "127.0.0.1:", text))
        run(shutil.which("nginx") or "/usr/sbin/nginx", "-t", "-p", folder, "-c", str(conf))
    return services


print(f"deploy/: {prometheus()} queries, {kubernetes()} Kubernetes objects, {compose()} services, one proxy: all read by their tools")
