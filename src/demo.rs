//! `vasculum demo`: the main job from end to end through the service, beside the truth.

use crate::arguments::{Demo, Image};
use crate::jobs::{advance, bar};
use crate::terminal::say;
use crate::{phantoms, table};
use anyhow::{Context, Result, bail};
use futures::StreamExt;
use phantom::Kind;
use reqwest::{Client, multipart};
use serde_json::Value;
use std::fs;
use std::io::{BufRead, BufReader, Cursor, IsTerminal, Write};
use std::path::Path;
use std::process::{Child, Command, ExitCode, Stdio};
use zip::write::SimpleFileOptions;

/// Simulate, serve, upload, follow, print, save.
pub(crate) fn demo(a: &Demo) -> ExitCode {
    let outcome = tokio::runtime::Runtime::new().map_err(anyhow::Error::from).and_then(|rt| rt.block_on(whole(a)));
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("vasculum demo: {e:#}");
            ExitCode::FAILURE
        }
    }
}

async fn whole(a: &Demo) -> Result<()> {
    fs::create_dir_all(&a.out).with_context(|| format!("cannot make {}", a.out.display()))?;
    eprintln!("simulating a scan of an end-to-side anastomosis (noise seed {}) ...", a.seed);
    let scan = a.out.join("scan");
    let image = Image { seed: Some(a.seed), ..Image::default() };
    phantoms::folder(Kind::Anastomosis, &phantoms::settings(Kind::Anastomosis, &image), &scan)?;
    let truth: Value = serde_json::from_slice(&fs::read(scan.join("truth.json"))?)?;

    let server = Server::start(&a.out.join("data"))?;
    service::tls::provide();
    let client = Client::new();
    let job = upload(&client, &server.address, &scan).await?;
    let id = job["id"].as_str().context("the service gave no job id")?;
    let state = follow(&client, &server.address, id).await?;
    if state != "succeeded" {
        let job: Value = client.get(format!("{}/v1/jobs/{id}", server.address)).send().await?.json().await?;
        bail!("the job ended as {state}: {}", job["error"]);
    }
    let result = save(&client, &server.address, id, &a.out.join("artefacts")).await?;
    say!("{}", table::angles(&result, Some(&truth)));
    say!("artefacts in {}\n", a.out.join("artefacts").display());
    say!("portal: {}/#/jobs/{id}\n", server.address);
    // Whoever came by `cargo xtask demo` has the command nowhere on the path yet.
    let own = std::env::current_exe()?;
    say!("your own scan: {} run FOLDER --out RESULT\n", own.display());
    if a.keep || std::io::stdin().is_terminal() {
        say!("the service keeps running; press Ctrl-C to stop it\n");
        tokio::signal::ctrl_c().await?;
    } else {
        say!("(the service stops now; --keep leaves it running, to look at the portal)\n");
    }
    Ok(())
}

/// A `vasculum serve` on its embedded defaults and a free port; ended when dropped.
struct Server {
    process: Child,
    address: String,
}

impl Server {
    fn start(data: &Path) -> Result<Self> {
        let mut process = Command::new(std::env::current_exe()?)
            .args(["serve", "--no-auth", "--listen", "127.0.0.1:0", "--data-dir"])
            .arg(data)
            .env("RUST_LOG", std::env::var("RUST_LOG").unwrap_or_else(|_| "warn".into()))
            .stdout(Stdio::piped())
            .spawn()
            .context("cannot start the service")?;
        let out = process.stdout.take().context("the service has no output")?;
        let mut lines = BufReader::new(out).lines();
        for line in lines.by_ref() {
            if let Some(address) = line?.strip_prefix("listening on ") {
                let address = address.trim().to_owned();
                eprintln!("service on {address}");
                // the pipe must stay drained, else the service would block on a full one
                std::thread::spawn(move || lines.for_each(drop));
                return Ok(Self { process, address });
            }
        }
        bail!("the service ended before it listened: {}", process.wait()?)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// The DICOM folder as one zip, with the plan that names the branches.
async fn upload(client: &Client, address: &str, scan: &Path) -> Result<Value> {
    let zip = zipped(&scan.join("dicom"))?;
    let size = zip.len();
    let form = multipart::Form::new()
        .part("plan", multipart::Part::bytes(fs::read(scan.join("plan.json"))?).mime_str("application/json")?)
        .part("input", multipart::Part::bytes(zip).file_name("scan.zip").mime_str("application/zip")?);
    let answer = client.post(format!("{address}/v1/jobs")).multipart(form).send().await?;
    let (status, body) = (answer.status(), answer.text().await?);
    if !status.is_success() {
        bail!("the upload was refused with {status}: {body}");
    }
    eprintln!("uploaded {:.1} MB of DICOM", size as f64 / 1e6);
    Ok(serde_json::from_str(&body)?)
}

fn zipped(folder: &Path) -> Result<Vec<u8>> {
    let mut writer = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let mut names: Vec<_> = fs::read_dir(folder)?.collect::<std::io::Result<Vec<_>>>()?;
    names.sort_by_key(std::fs::DirEntry::file_name);
    for entry in names {
        writer.start_file(entry.file_name().to_string_lossy(), SimpleFileOptions::default())?;
        writer.write_all(&fs::read(entry.path())?)?;
    }
    Ok(writer.finish()?.into_inner())
}

/// Follow the job's events to its end; gives its last state.
async fn follow(client: &Client, address: &str, id: &str) -> Result<String> {
    let bar = bar(1000);
    let request = client.get(format!("{address}/v1/jobs/{id}/events")).header("accept", "text/event-stream");
    let mut stream = request.send().await?.error_for_status()?.bytes_stream();
    let mut text = String::new();
    let mut stage = String::new();
    while let Some(chunk) = stream.next().await {
        text += &String::from_utf8_lossy(&chunk?);
        while let Some(end) = text.find('\n') {
            let line: String = text.drain(..=end).collect();
            let Some(data) = line.strip_prefix("data:") else { continue };
            let event: Value = serde_json::from_str(data.trim())?;
            let told = event["stage"].as_str().unwrap_or(&stage);
            advance(&bar, told, event["progress"].as_f64().unwrap_or(0.0), event["eta_s"].as_f64());
            if let Some(now) = event["stage"].as_str().filter(|now| *now != stage) {
                stage = now.to_owned();
                if bar.is_hidden() {
                    eprintln!("{stage}");
                }
            }
            if let Some(state @ ("succeeded" | "failed" | "cancelled")) = event["state"].as_str() {
                bar.finish_and_clear();
                return Ok(state.to_owned());
            }
        }
    }
    bail!("the events ended before the job did")
}

/// Save every artefact; gives result.json.
async fn save(client: &Client, address: &str, id: &str, out: &Path) -> Result<Value> {
    fs::create_dir_all(out)?;
    let base = format!("{address}/v1/jobs/{id}/artefacts");
    let list: Value = client.get(&base).send().await?.error_for_status()?.json().await?;
    let mut result = Value::Null;
    for item in list["items"].as_array().context("no list of artefacts")? {
        let name = item["name"].as_str().context("an artefact has no name")?;
        let bytes = client.get(format!("{base}/{name}")).send().await?.error_for_status()?.bytes().await?;
        fs::write(out.join(name), &bytes)?;
        if name == "result.json" {
            result = serde_json::from_slice(&bytes)?;
        }
    }
    if result.is_null() {
        bail!("the service gave no result.json");
    }
    Ok(result)
}
