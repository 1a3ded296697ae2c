//! A patient's name in every corner of an upload is found nowhere afterwards: database, store, working folders, temporary
//! files, logs, metrics, audit, artefacts and answers. Names of files may name a patient too: they go back to the client
//! that sent them, in the answer to that call, and nowhere else.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod serving;

use serde_json::Value;
use std::fs;
use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};
use tempfile::TempDir;

const BINARY: &str = env!("CARGO_BIN_EXE_vasculum");
/// In the content of files.
const NAME: &str = "Kanarienvogel";
/// In the names of files.
const FILE: &str = "Zaunkoenig";

struct Server {
    process: Child,
    address: String,
    folder: TempDir,
}

impl Server {
    /// With the most talkative log, and temporary files of its own.
    fn start() -> Self {
        service::tls::provide();
        let folder = TempDir::new().unwrap();
        fs::create_dir(folder.path().join("tmp")).unwrap();
        let log = fs::File::create(folder.path().join("log")).unwrap();
        let (process, address) = serving::serve(Path::new(BINARY), &folder.path().join("data"), |command| {
            command.args(["--stow-quiet-seconds", "0"]);
            command.env("RUST_LOG", "trace").env("TMPDIR", folder.path().join("tmp")).stderr(log);
        });
        Self { process, address, folder }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

fn element(tag: u32, vr: &str, value: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    out.extend(((tag >> 16) as u16).to_le_bytes());
    out.extend((tag as u16).to_le_bytes());
    out.extend(vr.as_bytes());
    let mut value = value.to_vec();
    value.resize(value.len() + value.len() % 2, b' ');
    if vr == "SQ" || vr == "UN" || vr == "OB" || vr == "UT" {
        out.extend([0, 0]);
        out.extend((value.len() as u32).to_le_bytes());
    } else {
        out.extend((value.len() as u16).to_le_bytes());
    }
    out.extend(value);
    out
}

/// A sequence of one item.
fn sequence(tag: u32, inside: &[Vec<u8>]) -> Vec<u8> {
    let inside = inside.concat();
    let mut item = vec![0xfe, 0xff, 0x00, 0xe0];
    item.extend((inside.len() as u32).to_le_bytes());
    item.extend(inside);
    element(tag, "SQ", &item)
}

/// Elements that name a patient, by tag: plain, nested twice, private, private inside a sequence, beyond the pixels.
fn names() -> Vec<(u32, Vec<u8>)> {
    let name = format!("{NAME}^Anna");
    let person = |tag| element(tag, "PN", name.as_bytes());
    let twice = sequence(0x0040_1012, &[element(0x0009_1001, "LO", name.as_bytes()), person(0x0010_0010)]);
    let mut all = vec![
        (0x0008_0080, element(0x0008_0080, "LO", name.as_bytes())),
        (0x0008_0090, person(0x0008_0090)),
        (0x0008_103e, element(0x0008_103e, "LO", name.as_bytes())),
        (0x0008_1140, sequence(0x0008_1140, &[person(0x0010_0010), twice])),
        (0x0009_0010, element(0x0009_0010, "LO", name.as_bytes())),
        (0x0009_1001, element(0x0009_1001, "UN", name.as_bytes())),
        (0x0009_1002, sequence(0x0009_1002, &[person(0x0010_0010)])),
        (0x0010_0010, person(0x0010_0010)),
        (0x0010_0020, element(0x0010_0020, "LO", name.as_bytes())),
        (0x0010_4000, element(0x0010_4000, "LT", name.as_bytes())),
        (0x0020_4000, element(0x0020_4000, "LT", name.as_bytes())),
        (0x0040_0275, sequence(0x0040_0275, &[sequence(0x0040_0008, &[person(0x0040_0006)])])),
    ];
    all.sort_by_key(|(tag, _)| *tag);
    all
}

/// One of our own slices (explicit little endian, known lengths) with the names in their places and behind the pixels.
fn named(slice: &[u8]) -> Vec<u8> {
    let mut names = names();
    let mut out = slice[..132].to_vec();
    out[..NAME.len()].copy_from_slice(NAME.as_bytes());
    let mut at = 132;
    while at < slice.len() {
        let half = |i: usize| u16::from_le_bytes([slice[at + i], slice[at + i + 1]]);
        let tag = (u32::from(half(0)) << 16) | u32::from(half(2));
        let long = ["OB", "OW", "SQ", "UN"].contains(&std::str::from_utf8(&slice[at + 4..at + 6]).unwrap());
        let length =
            if long { 12 + (usize::from(half(8)) | usize::from(half(10)) << 16) } else { 8 + usize::from(half(6)) };
        let mut replaced = false;
        while names.first().is_some_and(|(own, _)| *own <= tag) {
            let (own, bytes) = names.remove(0);
            replaced |= own == tag;
            out.extend(bytes);
        }
        if !replaced {
            out.extend(&slice[at..at + length]);
        }
        at += length;
    }
    out.extend(element(0xfffc_fffc, "OB", NAME.as_bytes()));
    out
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let paths = entries.flatten().map(|e| e.path());
    paths.flat_map(|p| if p.is_dir() { files(&p) } else { vec![p] }).collect()
}

/// Whether a text hides in bytes: as it is, in capitals or small, as UTF-16, or as base 64 at any of three offsets.
fn holds(bytes: &[u8], word: &str) -> bool {
    let found = |needle: &[u8]| bytes.windows(needle.len()).any(|w| w.eq_ignore_ascii_case(needle));
    let wide: Vec<u8> = word.encode_utf16().flat_map(u16::to_le_bytes).collect();
    let coded = (0..3).map(|skip| service::media::base64(&word.as_bytes()[skip..skip + 6]));
    found(word.as_bytes()) || found(&wide) || coded.into_iter().any(|text| found(text.as_bytes()))
}

fn assert_nowhere(folder: &Path) {
    for path in files(folder) {
        // A file that was erased meanwhile holds nothing.
        let Ok(bytes) = fs::read(&path) else { continue };
        for word in [NAME, FILE] {
            assert!(!holds(&bytes, word), "{word} is in {}", path.display());
            assert!(!path.to_string_lossy().contains(word), "{word} names {}", path.display());
        }
    }
}

fn zipped(files: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in files {
        zip.start_file(format!("{FILE}/{name}"), zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

async fn send(server: &Server, files: Vec<(String, Vec<u8>)>, plan: &str) -> (u16, String) {
    let mut form = reqwest::multipart::Form::new().text("plan", plan.to_owned());
    for (name, bytes) in files {
        form = form.part("input", reqwest::multipart::Part::bytes(bytes).file_name(name));
    }
    let answer =
        reqwest::Client::new().post(format!("{}/v1/jobs", server.address)).multipart(form).send().await.unwrap();
    (answer.status().as_u16(), answer.text().await.unwrap())
}

/// The same files over DICOMweb; the names of files come as a header that senders give.
async fn stow(server: &Server, files: &[(String, Vec<u8>)]) -> reqwest::Response {
    let mut body = Vec::new();
    for (name, bytes) in files {
        let head = format!("--edge\r\nContent-Type: application/dicom\r\nContent-Location: {name}\r\n\r\n");
        body.extend([head.as_bytes(), bytes, b"\r\n"].concat());
    }
    body.extend(b"--edge--\r\n");
    let kind = "multipart/related; type=\"application/dicom\"; boundary=edge";
    let request = reqwest::Client::new().post(format!("{}/dicomweb/studies", server.address));
    request.header("content-type", kind).body(body).send().await.unwrap()
}

async fn get(server: &Server, path: &str) -> Vec<u8> {
    let answer = reqwest::get(format!("{}{path}", server.address)).await.unwrap();
    answer.bytes().await.unwrap().to_vec()
}

/// Waits for the job's end and looks at every file of the service meanwhile.
async fn followed(server: &Server, id: &str) -> Value {
    let begun = Instant::now();
    loop {
        assert_nowhere(server.folder.path());
        let job: Value = serde_json::from_slice(&get(server, &format!("/v1/jobs/{id}")).await).unwrap();
        if ["succeeded", "failed"].contains(&job["state"].as_str().unwrap()) {
            return job;
        }
        assert!(begun.elapsed() < Duration::from_secs(120), "{job}");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

fn scan() -> Vec<(String, Vec<u8>)> {
    let folder = TempDir::new().unwrap();
    let out = folder.path().to_str().unwrap();
    let asked =
        ["phantom", "tube", "--distractors", "0", "--size", "64", "--slices", "24", "--seed", "1", "--out", out];
    let made = Command::new(BINARY).args(asked).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let mut slices = files(&folder.path().join("dicom"));
    slices.sort();
    let named = |(i, path): (usize, &PathBuf)| (format!("{FILE}_{i:03}.dcm"), named(&fs::read(path).unwrap()));
    slices.iter().enumerate().map(named).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_patients_name_is_found_nowhere() {
    let server = Server::start();
    let scan = scan();
    assert!(holds(&scan[0].1, NAME), "the test sends the name");
    // One upload that is worked on, as files and as a zip.
    let mut told = Vec::new();
    let archive = vec![(format!("{FILE}.zip"), zipped(&scan))];
    for files in [scan.clone(), archive] {
        let (status, text) = send(&server, files, "{}").await;
        assert_eq!(status, 202, "{text}");
        let job: Value = serde_json::from_str(&text).unwrap();
        let id = job["id"].as_str().unwrap().to_owned();
        told.push(followed(&server, &id).await.to_string().into_bytes());
        for path in ["/artefacts", "/events?after=0", "/result"] {
            told.push(get(&server, &format!("/v1/jobs/{id}{path}")).await);
        }
    }
    // The same over DICOMweb.
    let sent = stow(&server, &scan).await;
    assert_eq!(sent.status(), 200);
    let job = sent.headers()["location"].to_str().unwrap().to_owned();
    let answer: Value = serde_json::from_str(&sent.text().await.unwrap()).unwrap();
    told.push(followed(&server, job.rsplit('/').next().unwrap()).await.to_string().into_bytes());
    told.push(get(&server, &format!("{job}/result")).await);
    // The UIDs go back to their sender and are kept nowhere.
    let uid = answer["00081199"]["Value"][0]["00081155"]["Value"][0].as_str().unwrap();
    assert!(holds(&scan[0].1, uid), "{answer}");
    for path in files(server.folder.path()) {
        assert!(!holds(&fs::read(&path).unwrap_or_default(), uid), "{uid} is in {}", path.display());
    }
    told.push(answer.to_string().into_bytes());
    // Uploads that are refused: their content is not told, their file's name only to their sender.
    let mut cut = scan.clone();
    let half = cut[5].1.len() / 2;
    cut[5].1.truncate(half);
    let mut burned = scan.clone();
    let at = burned[0].1.windows(4).position(|w| w == [0x28, 0, 0x30, 0]).unwrap();
    burned[0].1.splice(at..at, element(0x0028_0301, "CS", b"YES"));
    let text = format!("{NAME} was here, {NAME} was not");
    let broken_plan = format!("{{\"roles\": {{\"{NAME}\": 1}}}}");
    let unread = stow(&server, &burned).await;
    assert_eq!(unread.status(), 202);
    told.push(unread.bytes().await.unwrap().to_vec());
    let refused = [
        (cut, "{}".to_owned()),
        (burned, "{}".to_owned()),
        (vec![(format!("{FILE}.txt"), text.clone().into_bytes())], "{}".to_owned()),
        (vec![(format!("{FILE}.nii"), format!("{text}{text}").repeat(20).into_bytes())], "{}".to_owned()),
        (
            vec![(format!("{FILE}.mha"), format!("NDims = {NAME}\nPatientName = {NAME}\n").into_bytes())],
            "{}".to_owned(),
        ),
        (vec![(format!("{FILE}.nrrd"), format!("NRRD0004\ntype: {NAME}\n").into_bytes())], "{}".to_owned()),
        (scan[..1].to_vec(), broken_plan),
    ];
    for (files, plan) in refused {
        let first = files[0].0.clone();
        let (status, text) = send(&server, files, &plan).await;
        assert!((400..500).contains(&status), "{first}: {status} {text}");
        // The plan's own field is the client's word about the plan, not the scan's about the patient.
        assert!(plan != "{}" || !holds(text.as_bytes(), NAME), "{first}: {text}");
    }
    told.push(get(&server, "/metrics").await);
    told.push(get(&server, "/v1/audit").await);
    told.push(get(&server, "/v1/jobs").await);
    for bytes in told {
        for word in [NAME, FILE] {
            assert!(!holds(&bytes, word), "{word}: {}", String::from_utf8_lossy(&bytes));
        }
    }
    assert_nowhere(server.folder.path());
    let log = fs::read(server.folder.path().join("log")).unwrap();
    assert!(log.len() > 1000, "the log was looked at");
}
