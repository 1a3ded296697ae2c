//! The release bars of the whole way through, against the binary: bytes, formats, service, kill, cancel, bad input.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod serving;

use serde_json::Value;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};
use tempfile::TempDir;

const BINARY: &str = env!("CARGO_BIN_EXE_vasculum");

/// One scan for all tests of this binary: small, so that a reconstruction takes seconds.
fn scan() -> &'static Path {
    static SCAN: OnceLock<TempDir> = OnceLock::new();
    SCAN.get_or_init(|| {
        let dir = TempDir::new().unwrap();
        let small = ["--size", "160", "--pixel", "0.8", "--slices", "27", "--spacing", "2.5"];
        let out =
            vasculum(&[&["phantom", "anastomosis", "--seed", "7", "--out", path(dir.path())], &small[..]].concat());
        assert!(out.status.success(), "{}", text(&out.stderr));
        dir
    })
    .path()
}

fn path(p: &Path) -> &str {
    p.to_str().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn vasculum(arguments: &[&str]) -> Output {
    Command::new(BINARY).args(arguments).stdin(Stdio::null()).output().unwrap()
}

/// Every artefact but provenance.json.
fn artefacts(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut all = BTreeMap::new();
    for entry in fs::read_dir(folder).unwrap() {
        let p = entry.unwrap().path();
        let name = p.file_name().unwrap().to_str().unwrap().to_owned();
        if name != "provenance.json" {
            all.insert(name, fs::read(&p).unwrap());
        }
    }
    all
}

fn assert_same_bytes(a: &BTreeMap<String, Vec<u8>>, b: &BTreeMap<String, Vec<u8>>) {
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>());
    for (name, bytes) in a {
        assert!(bytes == &b[name], "{name} differs");
    }
}

/// The artefacts of the scan with one thread.
fn reference() -> &'static BTreeMap<String, Vec<u8>> {
    static REFERENCE: OnceLock<BTreeMap<String, Vec<u8>>> = OnceLock::new();
    REFERENCE.get_or_init(|| run_with(&scan().join("dicom"), &scan().join("plan.json"), 1))
}

fn run_with(input: &Path, plan: &Path, threads: usize) -> BTreeMap<String, Vec<u8>> {
    let dir = TempDir::new().unwrap();
    let out = dir.path().join("out");
    let threads = threads.to_string();
    let done = vasculum(&["run", path(input), "--plan", path(plan), "--out", path(&out), "--threads", &threads]);
    assert!(done.status.success(), "{}", text(&done.stderr));
    artefacts(&out)
}

fn result(all: &BTreeMap<String, Vec<u8>>) -> Value {
    serde_json::from_slice(&all["result.json"]).unwrap()
}

#[test]
fn bytes_do_not_depend_on_the_number_of_threads() {
    for threads in [2, 3] {
        assert_same_bytes(reference(), &run_with(&scan().join("dicom"), &scan().join("plan.json"), threads));
    }
}

#[test]
fn the_graph_and_the_surface_are_those_of_a_bifurcation() {
    let r = result(reference());
    let nodes = r["graph"]["nodes"].as_array().unwrap();
    let count = |kind: &str| nodes.iter().filter(|n| n["kind"] == kind).count();
    assert_eq!((count("end"), count("junction")), (3, 1));
    assert_eq!(r["surface"]["watertight"], true);
    assert_eq!(r["surface"]["euler"], 2);
    assert_eq!(r["surface"]["components"], 1);
    assert!(r["surface"]["min_angle_deg"].as_f64().unwrap() >= 25.0);
    let px = &r["surface"]["displacement_px"];
    assert!(px["max"].as_f64().unwrap() <= 1.0 && px["min"].as_f64().unwrap() >= -1.0);
    for name in [
        "skeleton.json",
        "skeleton.vtp",
        "surface.vtp",
        "surface.glb",
        "surface.stl",
        "contours.vtp",
        "report.html",
        "angles.csv",
    ] {
        assert!(reference().contains_key(name), "{name} is missing");
    }
}

#[test]
fn dicom_nifti_and_png_of_one_stack_give_one_surface() {
    let dicom = result(reference());
    for (input, plan) in [("scan.nii", "plan.json"), ("png", "png/plan.json")] {
        let other = result(&run_with(&scan().join(input), &scan().join(plan), 2));
        assert_eq!(dicom["surface"]["triangles"], other["surface"]["triangles"], "{input}");
        for name in ["area_mm2", "volume_mm3"] {
            let (a, b) = (dicom["surface"][name].as_f64().unwrap(), other["surface"][name].as_f64().unwrap());
            assert!((a - b).abs() <= 1e-6 * a, "{input} {name}: {a} {b}");
        }
        let nodes = |r: &Value| -> Vec<f64> {
            let all = r["graph"]["nodes"].as_array().unwrap();
            all.iter().flat_map(|n| (0..3).map(|i| n["position"][i].as_f64().unwrap()).collect::<Vec<_>>()).collect()
        };
        for (a, b) in nodes(&dicom).iter().zip(nodes(&other)) {
            assert!((a - b).abs() <= 1e-6, "{input}: {a} {b}");
        }
    }
}

#[test]
fn the_order_of_files_and_their_numbers_change_nothing() {
    let dir = TempDir::new().unwrap();
    let mut names: Vec<PathBuf> = fs::read_dir(scan().join("dicom")).unwrap().map(|e| e.unwrap().path()).collect();
    names.sort();
    let count = names.len();
    for (k, name) in names.iter().enumerate() {
        // 17 is coprime to any stack size that is no multiple of it: a fixed shuffle
        fs::copy(name, dir.path().join(format!("{:04}.dcm", k * 17 % count))).unwrap();
    }
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), count, "the shuffle must be one to one");
    assert_same_bytes(reference(), &run_with(dir.path(), &scan().join("plan.json"), 2));
}

struct Server {
    process: Child,
    address: String,
    data: PathBuf,
}

impl Server {
    fn start(data: &Path) -> Self {
        service::tls::provide();
        let (process, address) = serving::serve(Path::new(BINARY), data, |_| ());
        Self { process, address, data: data.to_owned() }
    }
    fn kill(mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }
    fn get(&self, route: &str) -> reqwest::Response {
        block(reqwest::get(format!("{}{route}", self.address))).unwrap()
    }
    fn job(&self, id: &str) -> Value {
        block(self.get(&format!("/v1/jobs/{id}")).json()).unwrap()
    }
    fn submit(&self, files: Vec<(String, Vec<u8>)>, plan: Option<Vec<u8>>) -> reqwest::Response {
        let mut form = reqwest::multipart::Form::new();
        if let Some(plan) = plan {
            form = form.part("plan", reqwest::multipart::Part::bytes(plan));
        }
        for (name, bytes) in files {
            form = form.part("input", reqwest::multipart::Part::bytes(bytes).file_name(name));
        }
        let request = reqwest::Client::new().post(format!("{}/v1/jobs", self.address)).multipart(form);
        block(request.send()).unwrap()
    }
    fn submit_scan(&self) -> String {
        let answer = self.submit(dicom_files(), Some(fs::read(scan().join("plan.json")).unwrap()));
        assert_eq!(answer.status(), 202);
        let job: Value = block(answer.json()).unwrap();
        job["id"].as_str().unwrap().to_owned()
    }
    fn wait(&self, id: &str, until: impl Fn(&Value) -> bool, limit: Duration) -> Value {
        let start = Instant::now();
        loop {
            let job = self.job(id);
            if until(&job) {
                return job;
            }
            assert!(start.elapsed() < limit, "job stays {job}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }
    fn artefacts(&self, id: &str) -> BTreeMap<String, Vec<u8>> {
        let list: Value = block(self.get(&format!("/v1/jobs/{id}/artefacts")).json()).unwrap();
        let mut all = BTreeMap::new();
        for item in list["items"].as_array().unwrap() {
            let name = item["name"].as_str().unwrap();
            if name != "provenance.json" {
                let bytes = block(self.get(&format!("/v1/jobs/{id}/artefacts/{name}")).bytes()).unwrap();
                all.insert(name.to_owned(), bytes.to_vec());
            }
        }
        all
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// All requests of these tests share one runtime: a response outlives the call that made it.
fn block<T>(future: impl Future<Output = T>) -> T {
    static RUNTIME: OnceLock<tokio::runtime::Runtime> = OnceLock::new();
    service::tls::provide();
    RUNTIME.get_or_init(|| tokio::runtime::Runtime::new().unwrap()).block_on(future)
}

fn dicom_files() -> Vec<(String, Vec<u8>)> {
    let mut files: Vec<(String, Vec<u8>)> = fs::read_dir(scan().join("dicom"))
        .unwrap()
        .map(|e| e.unwrap().path())
        .map(|p| (p.file_name().unwrap().to_str().unwrap().to_owned(), fs::read(&p).unwrap()))
        .collect();
    files.sort();
    files
}

fn ended(job: &Value) -> bool {
    matches!(job["state"].as_str(), Some("succeeded" | "failed" | "cancelled"))
}

const LONG: Duration = Duration::from_secs(300);

#[test]
fn the_service_writes_the_same_bytes_also_after_a_kill() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path());
    let id = server.submit_scan();
    server.wait(&id, |j| j["state"] == "running" && j["progress"].as_f64().unwrap() > 0.1, LONG);
    server.kill();
    let server = Server::start(dir.path());
    let job = server.wait(&id, ended, LONG);
    assert_eq!(job["state"], "succeeded", "{job}");
    assert!(job["attempt"].as_u64().unwrap() >= 2, "{job}");
    assert_same_bytes(reference(), &server.artefacts(&id));
}

#[test]
fn a_cancelled_job_ends_at_once_and_leaves_nothing() {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path());
    let id = server.submit_scan();
    server.wait(&id, |j| j["state"] == "running" && j["progress"].as_f64().unwrap() > 0.05, LONG);
    let start = Instant::now();
    let cancel = reqwest::Client::new().post(format!("{}/v1/jobs/{id}/cancel", server.address)).send();
    assert!(block(cancel).unwrap().status().is_success());
    let job = server.wait(&id, ended, LONG);
    assert_eq!(job["state"], "cancelled");
    assert!(start.elapsed() < Duration::from_secs(2), "{:?}", start.elapsed());
    assert_eq!(files_below(&server.data.join("work")), Vec::<PathBuf>::new());
}

/// All files below a folder; an empty folder of a worker is none.
fn files_below(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let paths = entries.map(|e| e.unwrap().path());
    paths.flat_map(|p| if p.is_dir() { files_below(&p) } else { vec![p] }).collect()
}

/// A bad input, the code wanted.
fn bad_inputs(dir: &Path) -> Vec<(PathBuf, &'static str)> {
    let make = |name: &str| {
        let p = dir.join(name);
        fs::create_dir_all(&p).unwrap();
        p
    };
    let files = dicom_files();
    let put = |folder: &Path, name: &str, bytes: &[u8]| fs::write(folder.join(name), bytes).unwrap();
    let empty = make("no-images");
    put(&empty, "notes.txt", b"no picture at all");
    let truncated = make("truncated");
    files.iter().take(4).for_each(|(n, b)| put(&truncated, n, b));
    put(&truncated, "cut.dcm", &files[4].1[..files[4].1.len() / 2]);
    let twice = make("duplicate");
    files.iter().take(8).for_each(|(n, b)| put(&twice, n, b));
    put(&twice, "again.dcm", &files[3].1);
    let one = make("one-slice");
    put(&one, &files[0].0, &files[0].1);
    let png = make("png-without-geometry");
    for k in 0..5 {
        let name = format!("slice-{k:04}.png");
        let from = fs::read_dir(scan().join("png")).unwrap().map(|e| e.unwrap().path());
        let mut from: Vec<PathBuf> = from.filter(|p| p.extension().is_some_and(|e| e == "png")).collect();
        from.sort();
        fs::copy(&from[k], png.join(name)).unwrap();
    }
    vec![
        (empty, "input."),
        (truncated, "input.truncated"),
        (twice, "stack.duplicate_position"),
        (one, "stack.too_few_slices"),
        (png, "input.geometry_missing"),
    ]
}

#[test]
fn bad_input_is_refused_with_a_code_on_the_command_line_and_over_http() {
    let dir = TempDir::new().unwrap();
    let data = TempDir::new().unwrap();
    let server = Server::start(data.path());
    for (input, code) in bad_inputs(dir.path()) {
        let out = dir.path().join("out");
        let done = vasculum(&["run", path(&input), "--out", path(&out), "--json"]);
        assert_eq!(done.status.code(), Some(2), "{}: {}", input.display(), text(&done.stderr));
        let line = text(&done.stderr).lines().last().unwrap_or_default().to_owned();
        let problem: Value = serde_json::from_str(&line).unwrap_or_else(|e| panic!("{e}: {line}"));
        assert!(problem["code"].as_str().unwrap().starts_with(code), "{}: {problem}", input.display());
        assert!(!out.exists(), "something was left behind");

        let files = fs::read_dir(&input)
            .unwrap()
            .map(|e| e.unwrap().path())
            .map(|p| (p.file_name().unwrap().to_str().unwrap().to_owned(), fs::read(&p).unwrap()))
            .collect();
        let answer = server.submit(files, None);
        let status = answer.status().as_u16();
        let body: Value = block(answer.json()).unwrap();
        let told = if status == 202 {
            let job = server.wait(body["id"].as_str().unwrap(), ended, LONG);
            assert_eq!(job["state"], "failed");
            job["error"]["code"].clone()
        } else {
            assert!((400..500).contains(&status), "{status}: {body}");
            body["code"].clone()
        };
        assert!(told.as_str().unwrap().starts_with(code), "{}: {told}", input.display());
    }
    // left only what was accepted: no working folder
    assert_eq!(files_below(&data.path().join("work")), Vec::<PathBuf>::new());
}

#[test]
fn an_unknown_plan_field_is_refused_with_the_nearest_name() {
    let dir = TempDir::new().unwrap();
    let plan = dir.path().join("plan.json");
    fs::write(&plan, r#"{"segmentation": {"treshold": 100}}"#).unwrap();
    let out = dir.path().join("out");
    let done = vasculum(&["run", path(&scan().join("dicom")), "--plan", path(&plan), "--out", path(&out), "--json"]);
    assert_eq!(done.status.code(), Some(2));
    let said = text(&done.stderr);
    assert!(said.contains("plan.unknown_field") && said.contains("threshold"), "{said}");

    let data = TempDir::new().unwrap();
    let server = Server::start(data.path());
    let answer = server.submit(dicom_files(), Some(fs::read(&plan).unwrap()));
    assert_eq!(answer.status(), 422);
    assert_eq!(answer.headers()["content-type"], "application/problem+json");
    let body: Value = block(answer.json()).unwrap();
    assert_eq!(body["code"], "plan.unknown_field");
}

/// A MetaImage of grey values given by a function of (column, row, slice).
fn volume(file: &Path, size: [usize; 3], grey: impl Fn(usize, usize, usize) -> u16) {
    let mut bytes = format!(
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nOffset = 0 0 0\n\
         TransformMatrix = 1 0 0 0 1 0 0 0 1\nElementSpacing = 0.5 0.5 1.5\nDimSize = {} {} {}\n\
         ElementType = MET_USHORT\nElementDataFile = LOCAL\n",
        size[0], size[1], size[2]
    )
    .into_bytes();
    for k in 0..size[2] {
        for j in 0..size[1] {
            for i in 0..size[0] {
                bytes.extend(grey(i, j, k).to_le_bytes());
            }
        }
    }
    fs::write(file, bytes).unwrap();
}

#[test]
fn a_scan_without_a_vessel_is_refused() {
    let dir = TempDir::new().unwrap();
    let black = dir.path().join("black.mha");
    volume(&black, [64, 64, 20], |_, _, _| 0);
    let noise = dir.path().join("noise.mha");
    let hash = |i: usize, j: usize, k: usize| {
        let mut x = (i + 64 * (j + 64 * k)) as u64;
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ (x >> 31)) % 400) as u16
    };
    volume(&noise, [64, 64, 20], hash);
    let huge = dir.path().join("huge.mha");
    let header = "ObjectType = Image\nNDims = 3\nElementSpacing = 1 1 1\nDimSize = 70000 70000 10\nElementType = MET_USHORT\nElementDataFile = LOCAL\n";
    fs::write(&huge, header).unwrap();
    for (input, exit, code) in
        [(&black, 2, "stack.uniform"), (&noise, 2, "segmentation.no_vessel"), (&huge, 3, "input.too_large")]
    {
        let out = dir.path().join("out");
        let done = vasculum(&["run", path(input), "--out", path(&out), "--json"]);
        let said = text(&done.stderr);
        assert_eq!(done.status.code(), Some(exit), "{}: {said}", input.display());
        assert!(said.contains(code), "{}: {said}", input.display());
        assert!(!out.exists());
    }
}
