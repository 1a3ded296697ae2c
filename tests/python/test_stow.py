"""STOW-RS from programs that we did not write: Orthanc (its DICOMweb plugin, fed by dcmtk's storescu) and dicomweb-client.

Orthanc cuts a series into requests of 10 instances: one job must come of it, with every slice, and end. What was sent and
what the job read are the same stack: the job's result is that of the same files as a zip.
"""

import io
import json
import os
import pathlib
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
import zipfile

import dicomweb_client
import pydicom
import requests
from shared.serving import serve

scan = pathlib.Path(os.environ["VASCULUM_SCAN"])
slices = sorted((scan / "dicom").glob("*.dcm"))
assert len(slices) > 20, "the phantom's slices"


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def plugin():
    places = [pathlib.Path("/usr/share/orthanc/plugins"), pathlib.Path("/usr/lib/orthanc/plugins")]
    found = [file for place in places if place.is_dir() for file in place.glob("libOrthancDicomWeb.so*")]
    assert found, "orthanc-dicomweb is not installed"
    return str(found[0])


def orthanc(folder, address, key):
    """Orthanc with our service as a DICOMweb peer; its HTTP and DICOM ports."""
    http, dicom = free_port(), free_port()
    settings = {
        "Name": "ward", "StorageDirectory": str(folder / "pacs"), "IndexDirectory": str(folder / "pacs"),
        "HttpPort": http, "DicomPort": dicom, "DicomAet": "WARD", "RemoteAccessAllowed": False, "AuthenticationEnabled": False,
        "Plugins": [plugin()],
        "DicomWeb": {"Servers": {"vasculum": {"Url": address + "/dicomweb/", "HttpHeaders": {"Authorization": "Bearer " + key}}}},
    }
    (folder / "pacs").mkdir()
    (folder / "orthanc.json").write_text(json.dumps(settings))
    program = shutil.which("Orthanc") or "/usr/sbin/Orthanc"
    process = subprocess.Popen([program, str(folder / "orthanc.json")], stdout=subprocess.DEVNULL, stderr=open(folder / "orthanc.log", "w"))
    for _ in range(100):
        try:
            urllib.request.urlopen(f"http://127.0.0.1:{http}/system", timeout=2).read()
            return process, http, dicom
        except OSError:
            time.sleep(0.1)
    sys.exit("Orthanc did not start: " + (folder / "orthanc.log").read_text())


def ended(session, address, job):
    for _ in range(20):
        told = session.get(f"{address}{job}?wait=30", timeout=60).json()
        if told["state"] in ("succeeded", "failed", "cancelled"):
            return told
    sys.exit(f"the job does not end: {told}")


def zipped(session, address):
    """The same files, sent as a zip."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for file in slices:
            archive.write(file, file.name)
    sent = session.post(address + "/v1/jobs", files={"input": ("scan.zip", buffer.getvalue())}, timeout=60)
    assert sent.status_code == 202, sent.text
    return sent.headers["Location"]


def from_orthanc(session, address, http, dicom, log):
    subprocess.run(["storescu", "127.0.0.1", str(dicom), "-aec", "WARD", *map(str, slices)], check=True, timeout=60)
    peer = f"http://127.0.0.1:{http}"
    [series] = requests.get(peer + "/series", timeout=10).json()
    sent = requests.post(f"{peer}/dicom-web/servers/vasculum/stow", json={"Resources": [series], "Synchronous": True}, timeout=120)
    assert sent.status_code == 200, sent.text + log.read_text()
    [job] = session.get(address + "/v1/jobs", timeout=10).json()["items"]
    assert job["input"]["files"] == len(slices), f"one job with every slice: {job}"
    return "/v1/jobs/" + job["id"]


def from_client(session, address):
    """Two requests of dicomweb-client; another series of another study, so that it is another job."""
    client = dicomweb_client.DICOMwebClient(address + "/dicomweb", session=session)
    study, series = pydicom.uid.generate_uid(), pydicom.uid.generate_uid()
    sets = []
    for file in slices:
        one = pydicom.dcmread(file)
        one.StudyInstanceUID, one.SeriesInstanceUID, one.SOPInstanceUID = study, series, pydicom.uid.generate_uid()
        one.file_meta.MediaStorageSOPInstanceUID = one.SOPInstanceUID
        sets.append(one)
    half = len(sets) // 2
    answers = [client.store_instances(sets[:half]), client.store_instances(sets[half:], study_instance_uid=study)]
    taken = {item.ReferencedSOPInstanceUID for answer in answers for item in answer.ReferencedSOPSequence}
    assert taken == {one.SOPInstanceUID for one in sets}
    assert not any("FailedSOPSequence" in answer for answer in answers)
    private = answers[0].ReferencedSOPSequence[0].private_block(0x0009, "VASCULUM")
    job = private[0x01].value
    assert job == answers[1].ReferencedSOPSequence[0].private_block(0x0009, "VASCULUM")[0x01].value, "both requests are one job"
    return job


def main():
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        service, address, key = serve(folder / "data", "--stow-quiet-seconds", "3", stderr=subprocess.DEVNULL)
        pacs = None
        try:
            session = requests.Session()
            session.headers["Authorization"] = "Bearer " + key
            pacs, http, dicom = orthanc(folder, address, key)
            jobs = [from_orthanc(session, address, http, dicom, folder / "orthanc.log"), from_client(session, address), zipped(session, address)]
            results = []
            for job in jobs:
                told = ended(session, address, job)
                assert told["state"] == "succeeded", told
                results.append(session.get(f"{address}{job}/result", timeout=10).json())
            for result in results[:2]:
                assert result["junctions"] == results[2]["junctions"] and result["surface"] == results[2]["surface"]
        finally:
            for process in (pacs, service):
                if process:
                    process.terminate()
                    process.wait(timeout=30)
    print(f"STOW-RS: {len(slices)} slices by Orthanc and by dicomweb-client, one job each, the same result as by zip")


main()
