//! What an operator may set. The binary parses the command line and the environment into [`Config`]; nothing below
//! reads either.

use crate::cohort::{self, NewTable};
use crate::error::Problem;
use crate::tls::Tls;
use std::net::SocketAddr;
use std::path::PathBuf;

/// A file of an upload: its name inside the upload and its bytes.
pub type NamedBytes = (String, Vec<u8>);

/// Reads an upload before anything touches disk: unpacks archives within limits, de-identifies DICOM, refuses what
/// cannot be read. Runs on a blocking thread.
pub type Intake = fn(Vec<NamedBytes>) -> Result<Vec<NamedBytes>, Problem>;

/// A DICOM instance as it was received: its names for the answer to its sender, and the file to keep.
#[derive(Clone, Debug)]
pub struct Instance {
    /// SOPClassUID.
    pub class: String,
    /// SOPInstanceUID.
    pub instance: String,
    /// StudyInstanceUID.
    pub study: String,
    /// SeriesInstanceUID.
    pub series: String,
    /// The de-identified file, or why it is not taken.
    pub file: Result<Vec<u8>, Problem>,
}

/// Reads one DICOM instance, de-identifies it. Runs on a blocking thread.
pub type Receive = fn(&[u8]) -> Instance;

/// Checks the bytes of a plan; every fault at once.
pub type CheckPlan = fn(&[u8]) -> Result<(), Problem>;

/// Tells what a scan and its plan would be understood as, without a reconstruction. Runs on a blocking thread.
pub type CheckScan = fn(Vec<NamedBytes>, &str) -> Result<serde_json::Value, Problem>;

/// Who may call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Auth {
    /// Every call under `/v1` needs an API key. The first start makes an admin key and prints it once.
    Required,
    /// No keys. Only on a loopback address, and only for a Host header that names it (DNS rebinding).
    None,
}

/// An identity provider whose bearer tokens count beside API keys.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Oidc {
    /// `iss` of its tokens.
    pub issuer: String,
    /// `aud` that a token for this service carries.
    pub audience: String,
    /// Where its public keys are (JSON Web Key Set).
    pub jwks_url: String,
    /// Claim that names the tenant; dots lead into objects. Default `tenant`.
    pub tenant_claim: String,
    /// Claim that names the role, or a list of roles. Default `role`.
    pub role_claim: String,
    /// The keys are not fetched more often than this for a key that is not known, seconds. Default 60.
    pub refresh_seconds: u64,
}

impl Default for Oidc {
    fn default() -> Self {
        Self {
            issuer: String::new(),
            audience: String::new(),
            jwks_url: String::new(),
            tenant_claim: "tenant".to_owned(),
            role_claim: "role".to_owned(),
            refresh_seconds: 60,
        }
    }
}

/// Settings of the service. `Default` gives one machine: SQLite and a local folder, loopback, keys required.
#[derive(Clone, Debug)]
pub struct Config {
    /// Database, artefact folder, working folders and locks live here. Made if missing. Default `./vasculum-data`.
    pub data_dir: PathBuf,
    /// Address to listen on; port 0 takes a free one, printed and written to `<data_dir>/listen`.
    /// Default 127.0.0.1:8080.
    pub listen: SocketAddr,
    /// Certificate of the listener; without one it speaks plain HTTP. Default none.
    pub tls: Option<Tls>,
    /// `sqlite:PATH` or `postgres://USER:PASSWORD@HOST/DATABASE`; default `sqlite:<data_dir>/vasculum.sqlite`.
    pub database_url: Option<String>,
    /// Connections to PostgreSQL that this process may hold (plus one for beats and one for hints). Default 8.
    pub database_connections: u32,
    /// `file:PATH` or `s3://BUCKET[/PREFIX]` (keys and endpoint in [`Config::s3`]); default `<data_dir>/store`.
    pub store_url: Option<String>,
    /// Settings of an S3 store by their names in AWS's tools without `AWS_`, such as `endpoint` or `region`.
    pub s3: Vec<(String, String)>,
    /// Jobs that run at the same time, each in its own process. 0: this process only serves. Default 1.
    pub workers: usize,
    /// `--threads` of each job's process; 0 lets the process take all cores. Default 0.
    pub threads: usize,
    /// Memory that all jobs of this process may take together, MiB; 0: three quarters of what the machine has free at
    /// start. A job's process is bound to its share. Default 0.
    pub memory_mb: u64,
    /// Longest time of one start of a job, seconds; 0: no bound. Default 6 hours.
    pub job_seconds: u64,
    /// Who may call. Default [`Auth::Required`].
    pub auth: Auth,
    /// An identity provider whose tokens count too. Default none.
    pub oidc: Option<Oidc>,
    /// The program whose `exec-job` sub-command runs one job. Default: this program.
    pub executable: PathBuf,
    /// Arguments put before `exec-job` (none by default; an interpreter's script in tests).
    pub executable_args: Vec<String>,
    /// Where machines share a store, objects that no row names are swept once they are this old, seconds. Default 3600.
    pub sweep_seconds: u64,
    /// Hosts to which webhooks may go though they lie in a network that is not public, by plain http too. Default none.
    pub webhook_hosts: Vec<String>,
    /// Origins whose pages may show a result's view in a frame, such as `https://portal.example.org`. Default none.
    pub frame_ancestors: Vec<String>,
    /// Largest request body, bytes. Default 2 GiB.
    pub max_body: u64,
    /// Bytes of uploads held in memory at the same time over all requests, beyond which a new one is asked to come
    /// again (503). At least `max_body`. Default 4 GiB.
    pub upload_memory: u64,
    /// A collector of traces (OTLP over HTTP), such as `http://127.0.0.1:4318`. Default none.
    pub otlp_endpoint: Option<String>,
    /// `/readyz` says no when the data folder's disk has less than this, bytes. Default 256 MiB.
    pub min_free_disk: u64,
    /// Reads an upload. Default: takes the files as they are; the binary wires `artefact::read::intake`.
    pub intake: Intake,
    /// Reads a DICOM instance of DICOMweb. Default: takes none; the binary wires `artefact::read::instance`.
    pub receive: Receive,
    /// A series that comes over DICOMweb is run when nothing more of it has come for this long, seconds. Default 30.
    pub stow_quiet_seconds: u64,
    /// Checks a plan. Default: any JSON object; the binary wires the artefact crate's reader.
    pub check_plan: CheckPlan,
    /// Reads a scan for `?validate=true`. Default: null; the binary wires the pipeline's reader.
    pub check_scan: CheckScan,
    /// Makes the table of many results for `GET /v1/cohort`. Default: it only counts; the binary wires the artefact
    /// crate's.
    pub cohort: NewTable,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            data_dir: PathBuf::from("vasculum-data"),
            listen: SocketAddr::from(([127, 0, 0, 1], 8080)),
            tls: None,
            database_url: None,
            database_connections: 8,
            store_url: None,
            s3: Vec::new(),
            memory_mb: 0,
            job_seconds: 6 * 3600,
            sweep_seconds: 3600,
            webhook_hosts: Vec::new(),
            frame_ancestors: Vec::new(),
            workers: 1,
            threads: 0,
            auth: Auth::Required,
            oidc: None,
            executable: std::env::current_exe().unwrap_or_else(|_| PathBuf::from("vasculum")),
            executable_args: Vec::new(),
            max_body: 2 << 30,
            upload_memory: 4 << 30,
            otlp_endpoint: None,
            min_free_disk: 256 << 20,
            intake: Ok,
            receive: crate::intake::no_instance,
            stow_quiet_seconds: 30,
            check_plan: crate::intake::json_object,
            check_scan: |_, _| Ok(serde_json::Value::Null),
            cohort: cohort::count,
        }
    }
}

impl Config {
    /// The SQLite file.
    ///
    /// # Errors
    /// A `database_url` of another scheme.
    pub fn database_file(&self) -> anyhow::Result<PathBuf> {
        match &self.database_url {
            None => Ok(self.data_dir.join("vasculum.sqlite")),
            Some(url) => path_of(url, "sqlite:").ok_or_else(|| {
                anyhow::anyhow!("--database-url must be sqlite:PATH or postgres://USER:PASSWORD@HOST/DATABASE")
            }),
        }
    }

    /// Where artefacts go.
    ///
    /// # Errors
    /// A `store_url` that is not understood.
    pub fn store_place(&self) -> anyhow::Result<StorePlace> {
        let Some(url) = &self.store_url else { return Ok(StorePlace::Folder(self.data_dir.join("store"))) };
        if let Some(rest) = url.strip_prefix("s3://") {
            let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
            anyhow::ensure!(bucket.len() >= 3, "a bucket's name has three characters or more: {url}");
            return Ok(StorePlace::S3 { bucket: bucket.to_owned(), prefix: prefix.trim_matches('/').to_owned() });
        }
        let folder = path_of(url, "file:");
        folder
            .map(StorePlace::Folder)
            .ok_or_else(|| anyhow::anyhow!("--store-url must be file:PATH or s3://BUCKET/PREFIX, not {url}"))
    }

    /// Whether other machines may use the same database.
    pub fn is_shared(&self) -> bool {
        self.database_url.as_deref().is_some_and(|url| url.starts_with("postgres"))
    }
}

/// A store's place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StorePlace {
    /// A folder of this machine.
    Folder(PathBuf),
    /// A bucket and a prefix inside it.
    S3 {
        /// Bucket.
        bucket: String,
        /// Prefix without slashes at its ends; may be empty.
        prefix: String,
    },
}

/// The path of `scheme:PATH` or `scheme://PATH`.
fn path_of(url: &str, scheme: &str) -> Option<PathBuf> {
    let rest = url.strip_prefix(scheme)?;
    let path = rest.strip_prefix("//").unwrap_or(rest);
    (!path.is_empty()).then(|| PathBuf::from(path))
}
