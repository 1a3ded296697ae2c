//! provenance.json: who made the artefacts, when, how long it took. The only artefact that differs from run to run.

use super::{Error, NamedBytes, PROVENANCE_JSON};
use crate::plan::Plan;
use serde::Serialize;

/// Time and memory of one stage.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct StageTime {
    /// Name of the stage, as in the events.
    pub stage: String,
    /// Wall clock, s.
    pub wall_s: f64,
    /// Processor time of all threads, s, where the system tells.
    pub cpu_s: Option<f64>,
    /// Largest resident memory so far, bytes, where the system tells.
    pub peak_bytes: Option<u64>,
}

/// What provenance.json tells beside the artefacts' digests. Times are strings given by the caller (RFC 3339, UTC).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Provenance {
    /// Version of the program.
    pub version: String,
    /// Operating system and architecture, such as `linux x86_64`; no host name.
    pub host_os: String,
    /// Threads used.
    pub threads: usize,
    /// When the job began.
    pub started_at: String,
    /// When it ended.
    pub finished_at: Option<String>,
    /// Digest of the input.
    pub input_digest: String,
    /// The plan in force, defaults filled in.
    pub plan: Plan,
    /// Results that an earlier run's field.bin gave.
    pub recalled: usize,
    /// By stage, in order.
    pub stages: Vec<StageTime>,
    /// Largest resident memory of the process, bytes.
    pub peak_memory_bytes: Option<u64>,
}

#[derive(Serialize)]
struct Document<'a> {
    schema: &'static str,
    version: &'a str,
    host_os: &'a str,
    threads: usize,
    started_at: &'a str,
    finished_at: Option<&'a str>,
    wall_s: f64,
    cpu_s: Option<f64>,
    peak_memory_bytes: Option<u64>,
    input: Input<'a>,
    plan: &'a Plan,
    recalled: usize,
    stages: &'a [StageTime],
    artefacts: Vec<Artefact<'a>>,
}

#[derive(Serialize)]
struct Input<'a> {
    digest: &'a str,
}

#[derive(Serialize)]
struct Artefact<'a> {
    name: &'a str,
    media_type: &'static str,
    bytes: usize,
    digest: String,
}

/// provenance.json, with name, size and digest of every artefact given.
///
/// # Errors
/// [`Error::NotFinite`] for a time that is not finite; [`Error::Encode`].
pub fn provenance(p: &Provenance, artefacts: &[NamedBytes]) -> Result<NamedBytes, Error> {
    for (i, s) in p.stages.iter().enumerate() {
        super::error::all_finite(PROVENANCE_JSON, &format!("$.stages[{i}]"), &[s.wall_s, s.cpu_s.unwrap_or(0.0)])?;
    }
    let cpu: Option<Vec<f64>> = p.stages.iter().map(|s| s.cpu_s).collect();
    let document = Document {
        schema: "vasculum/provenance/1",
        version: &p.version,
        host_os: &p.host_os,
        threads: p.threads,
        started_at: &p.started_at,
        finished_at: p.finished_at.as_deref(),
        wall_s: p.stages.iter().fold(0.0, |s, x| s + x.wall_s),
        cpu_s: cpu.map(|c| c.iter().fold(0.0, |s, x| s + x)),
        peak_memory_bytes: p.peak_memory_bytes,
        input: Input { digest: &p.input_digest },
        plan: &p.plan,
        recalled: p.recalled,
        stages: &p.stages,
        artefacts: artefacts
            .iter()
            .map(|a| Artefact {
                name: &a.name,
                media_type: super::media_type(&a.name),
                bytes: a.bytes.len(),
                digest: a.digest(),
            })
            .collect(),
    };
    let mut bytes = serde_json::to_vec_pretty(&document)
        .map_err(|e| Error::Encode { artefact: PROVENANCE_JSON, reason: e.to_string() })?;
    bytes.push(b'\n');
    Ok(NamedBytes::new(PROVENANCE_JSON, bytes))
}
