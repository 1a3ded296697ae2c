//! The command line (names fixed by the contract with our users).

use clap::{Args, Parser, Subcommand};
use std::net::SocketAddr;
use std::path::PathBuf;

/// Reconstructs blood vessels and their bifurcations from stacks of MRI or CT slices.
#[derive(Parser)]
#[command(name = "vasculum", version, about, arg_required_else_help = true)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Subcommand)]
pub(crate) enum Command {
    /// API, portal and workers in one process tree.
    Serve(Serve),
    /// A worker without API against the same database and store.
    Work(Serve),
    /// The whole reconstruction without a service.
    Run(Run),
    /// Change the medial lines of a finished reconstruction and make the vessels anew around them.
    Vary(Vary),
    /// The angles and branches of many finished reconstructions together.
    Cohort(Cohort),
    /// Read and check a scan and a plan; nothing is reconstructed.
    Validate(Validate),
    /// A simulated scan with exact truth: DICOM, PNG + plan, NIfTI, truth.json.
    Phantom(Phantom),
    /// Start the service, reconstruct a simulated scan through it, show the angles beside the truth.
    Demo(Demo),
    /// Bring the database to this version's schema.
    Migrate(Data),
    /// Copy the SQLite database consistently while the service runs.
    Backup(Backup),
    /// API keys.
    Key(Key),
    /// Tenants: what they may do and how long their jobs are kept.
    Tenant(Tenant),
    /// Check that no line of the audit was changed, moved or taken out.
    VerifyAudit(VerifyAudit),
    /// The angle table and the warnings of a finished reconstruction.
    Show(Show),
    /// Print the API's description (OpenAPI 3.1, YAML).
    Openapi,
    /// Print the version.
    Version,
    /// Print the manual's page (`vasculum man | man -l -`), or write one for each command.
    Man(Man),
    /// Print what a shell needs to complete these commands and options.
    Completions(Completions),
    /// One job of a worker (its parent speaks to it over standard input and output).
    #[command(hide = true)]
    ExecJob(ExecJob),
}

#[derive(Args)]
pub(crate) struct Data {
    /// Database, artefacts and working folders live here.
    #[arg(long, default_value = "vasculum-data", env = "VASCULUM_DATA_DIR")]
    pub(crate) data_dir: PathBuf,
    /// sqlite:PATH (default: inside the data folder) or postgres://USER:PASSWORD@HOST/DATABASE.
    #[arg(long, env = "VASCULUM_DATABASE_URL")]
    pub(crate) database_url: Option<String>,
    /// file:PATH (default: inside the data folder) or s3://BUCKET/PREFIX (VASCULUM_S3_ENDPOINT, VASCULUM_S3_REGION,
    /// VASCULUM_S3_ACCESS_KEY_ID, VASCULUM_S3_SECRET_ACCESS_KEY).
    #[arg(long, env = "VASCULUM_STORE_URL")]
    pub(crate) store_url: Option<String>,
}

#[derive(Args)]
pub(crate) struct Serve {
    #[command(flatten)]
    pub(crate) data: Data,
    /// Address of the API and the portal; port 0 takes a free one.
    #[arg(long, default_value = "127.0.0.1:8080", env = "VASCULUM_LISTEN")]
    pub(crate) listen: SocketAddr,
    /// Certificate of the listener with its chain, PEM; read again when it changes or on SIGHUP. Plain HTTP without.
    #[arg(long, env = "VASCULUM_TLS_CERT", requires = "tls_key")]
    pub(crate) tls_cert: Option<PathBuf>,
    /// The certificate's private key, PEM.
    #[arg(long, env = "VASCULUM_TLS_KEY", requires = "tls_cert")]
    pub(crate) tls_key: Option<PathBuf>,
    /// Jobs at the same time.
    #[arg(long, default_value_t = 1)]
    pub(crate) workers: usize,
    /// Threads of each job (default: all cores; results do not depend on it).
    #[arg(long)]
    pub(crate) threads: Option<usize>,
    /// Memory of all jobs together, MiB (default: three quarters of what is free at start).
    #[arg(long, default_value_t = 0, env = "VASCULUM_MEMORY_MB")]
    pub(crate) memory_mb: u64,
    /// Longest time of one job, seconds; 0: no bound.
    #[arg(long, default_value_t = 21_600)]
    pub(crate) job_seconds: u64,
    /// A series that is sent by DICOMweb is run when nothing more of it has come for this long, seconds.
    #[arg(long, default_value_t = 30, env = "VASCULUM_STOW_QUIET_SECONDS")]
    pub(crate) stow_quiet_seconds: u64,
    /// A collector of traces (OTLP over HTTP), such as http://127.0.0.1:4318.
    #[arg(long, env = "VASCULUM_OTLP_ENDPOINT")]
    pub(crate) otlp_endpoint: Option<String>,
    /// A host to which webhooks may go though its network is not public; may be given several times.
    #[arg(long = "webhook-host")]
    pub(crate) webhook_hosts: Vec<String>,
    /// An origin (https://host) whose pages may show a result in a frame; may be given several times.
    #[arg(long = "frame-ancestor", value_parser = origin)]
    pub(crate) frame_ancestors: Vec<String>,
    /// No API keys: only on a loopback address.
    #[arg(long)]
    pub(crate) no_auth: bool,
    #[command(flatten)]
    pub(crate) oidc: OidcArgs,
}

/// An identity provider (OpenID Connect) whose bearer tokens count beside API keys.
#[derive(Args)]
pub(crate) struct OidcArgs {
    /// `iss` of the identity provider's tokens; with it, bearer tokens count beside API keys.
    #[arg(long, env = "VASCULUM_OIDC_ISSUER", requires_all = ["oidc_audience", "oidc_jwks_url"])]
    pub(crate) oidc_issuer: Option<String>,
    /// `aud` that a token for this service carries.
    #[arg(long, env = "VASCULUM_OIDC_AUDIENCE", requires = "oidc_issuer")]
    pub(crate) oidc_audience: Option<String>,
    /// Where the provider's public keys are (JSON Web Key Set); https, or http on this machine.
    #[arg(long, env = "VASCULUM_OIDC_JWKS_URL", requires = "oidc_issuer")]
    pub(crate) oidc_jwks_url: Option<String>,
    /// Claim that names the tenant (which must exist); dots lead into objects.
    #[arg(long, env = "VASCULUM_OIDC_TENANT_CLAIM", default_value = "tenant")]
    pub(crate) oidc_tenant_claim: String,
    /// Claim that names the role (upload, read, admin, auditor), or a list of which the strongest counts.
    #[arg(long, env = "VASCULUM_OIDC_ROLE_CLAIM", default_value = "role")]
    pub(crate) oidc_role_claim: String,
}

#[derive(Args)]
pub(crate) struct Key {
    #[command(subcommand)]
    pub(crate) action: KeyAction,
}

#[derive(Subcommand)]
pub(crate) enum KeyAction {
    /// Make a key and print it; it is shown only this once.
    Create {
        #[command(flatten)]
        data: Data,
        /// What the key is for.
        #[arg(long, default_value = "key")]
        name: String,
        /// upload, read, admin or auditor.
        #[arg(long, default_value = "admin")]
        role: String,
        /// Whose jobs the key sees; made if it is new.
        #[arg(long, default_value = "default")]
        tenant: String,
        /// Requests in a minute (default: no bound).
        #[arg(long)]
        requests_per_minute: Option<i64>,
        /// Largest upload, bytes (default: the service's bound).
        #[arg(long)]
        max_bytes: Option<i64>,
    },
    /// List every key: id, tenant, role, label; never the key itself.
    List {
        #[command(flatten)]
        data: Data,
    },
    /// Revoke a key at once.
    Revoke {
        #[command(flatten)]
        data: Data,
        /// The key's id, from the list.
        id: String,
    },
}

#[derive(Args)]
pub(crate) struct Tenant {
    #[command(subcommand)]
    pub(crate) action: TenantAction,
}

#[derive(Subcommand)]
pub(crate) enum TenantAction {
    /// Set a tenant's bounds; made if it is new. What is not given is lifted.
    Set {
        #[command(flatten)]
        data: Data,
        /// The tenant.
        name: String,
        /// Its jobs that may run at the same time.
        #[arg(long, value_parser = clap::value_parser!(i64).range(1..))]
        max_running: Option<i64>,
        /// Days after which an ended job erases itself.
        #[arg(long, value_parser = clap::value_parser!(i64).range(1..=36_500))]
        keep_days: Option<i64>,
    },
    /// List every tenant with its bounds.
    List {
        #[command(flatten)]
        data: Data,
    },
}

#[derive(Args)]
pub(crate) struct Backup {
    #[command(flatten)]
    pub(crate) data: Data,
    /// File to write; it must not exist.
    #[arg(long)]
    pub(crate) out: PathBuf,
}

#[derive(Args)]
pub(crate) struct VerifyAudit {
    #[command(flatten)]
    pub(crate) data: Data,
    /// Also print every line as a FHIR R4 AuditEvent resource (one JSON object per line).
    #[arg(long)]
    pub(crate) fhir: bool,
}

#[derive(Args)]
pub(crate) struct Run {
    /// A folder, a zip, DICOM files, one volume file, or grey slices in name order.
    #[arg(required = true)]
    pub(crate) input: Vec<PathBuf>,
    /// Folder for the artefacts; it appears whole or not at all.
    #[arg(long)]
    pub(crate) out: PathBuf,
    /// plan.json.
    #[arg(long)]
    pub(crate) plan: Option<PathBuf>,
    /// The folder of a finished reconstruction of the same scan that holds a field.bin: what other roles or settings of the mesh
    /// do not change is taken from it (large scans keep one; `"outputs": ["field"]` of a plan asks for it).
    #[arg(long)]
    pub(crate) earlier: Option<PathBuf>,
    /// Threads (default: all cores; the bytes do not depend on it).
    #[arg(long)]
    pub(crate) threads: Option<usize>,
    /// Results and errors as JSON.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Args)]
pub(crate) struct Vary {
    /// Folder of a finished reconstruction, or its sections.json.
    pub(crate) source: PathBuf,
    /// Folder for the variants, one folder each.
    #[arg(long)]
    pub(crate) out: PathBuf,
    /// BRANCH=DEGREES[,DEGREES...]: turned until the branch makes this angle with the proximal one (BRANCH:OTHER=... with
    /// another). BRANCH is graft, proximal, distal, host_a, host_b or a number. Several values make a series.
    #[arg(long, value_name = "BRANCH=DEG")]
    pub(crate) angle: Vec<String>,
    /// BRANCH=FACTOR[,FACTOR...]: every bend times a factor.
    #[arg(long, value_name = "BRANCH=FACTOR")]
    pub(crate) bend: Vec<String>,
    /// BRANCH=CURVATURE[,CURVATURE...]: constant curvature, 1/mm.
    #[arg(long, value_name = "BRANCH=PER_MM")]
    pub(crate) curvature: Vec<String>,
    /// BRANCH=TORSION[,TORSION...]: with --curvature, constant torsion, 1/mm, positive right-handed.
    #[arg(long, value_name = "BRANCH=PER_MM", allow_hyphen_values = true)]
    pub(crate) torsion: Vec<String>,
    /// BRANCH: straightened.
    #[arg(long, value_name = "BRANCH")]
    pub(crate) straight: Vec<String>,
    /// BRANCH: pressed into its junction's plane.
    #[arg(long, value_name = "BRANCH")]
    pub(crate) planar: Vec<String>,
    /// plan.json; its `variant`, if any, goes before the options. Given several times it makes several series.
    #[arg(long)]
    pub(crate) plan: Vec<PathBuf>,
    /// Threads (default: all cores; the bytes do not depend on it).
    #[arg(long)]
    pub(crate) threads: Option<usize>,
    /// Results and errors as JSON, one line a variant.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Args)]
pub(crate) struct Cohort {
    /// Folders of finished reconstructions, or result.json files.
    #[arg(required = true)]
    pub(crate) input: Vec<PathBuf>,
    /// Folder for cohort.csv, cohort.json and cohort.svg.
    #[arg(long)]
    pub(crate) out: Option<PathBuf>,
    /// Only this angle or branch role; may be given several times.
    #[arg(long)]
    pub(crate) name: Vec<String>,
    /// Only this quantity (deg, diameter_mm, area_mm2, ...); may be given several times.
    #[arg(long)]
    pub(crate) quantity: Vec<String>,
    /// Only angles or only branches.
    #[arg(long, value_parser = ["angle", "branch"])]
    pub(crate) kind: Vec<String>,
    /// Only the branch with this number; may be given several times.
    #[arg(long)]
    pub(crate) branch: Vec<u64>,
    /// Only reconstructions of scans, or only variants.
    #[arg(long, value_parser = ["reconstruction", "variant"])]
    pub(crate) job_kind: Option<String>,
    /// Leave out results with warnings.
    #[arg(long)]
    pub(crate) without_warnings: bool,
    /// Rows and spreads as JSON on standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Args)]
pub(crate) struct Show {
    /// The folder of a finished reconstruction, or its result.json.
    pub(crate) result: PathBuf,
    /// The whole result.json.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Args)]
pub(crate) struct Man {
    /// A folder for vasculum.1 and one page for each command, such as /usr/local/share/man/man1.
    #[arg(long)]
    pub(crate) out: Option<PathBuf>,
}

#[derive(Args)]
pub(crate) struct Completions {
    /// The shell. For bash: `vasculum completions bash > /etc/bash_completion.d/vasculum`.
    pub(crate) shell: clap_complete::Shell,
}

#[derive(Args)]
pub(crate) struct Validate {
    /// As for `run`.
    #[arg(required = true)]
    pub(crate) input: Vec<PathBuf>,
    /// plan.json.
    #[arg(long)]
    pub(crate) plan: Option<PathBuf>,
    /// Threads (default: all cores).
    #[arg(long)]
    pub(crate) threads: Option<usize>,
    /// What was understood, or the fault, as JSON.
    #[arg(long)]
    pub(crate) json: bool,
    /// Read only, and write the grey values to this file (little-endian singles); nothing is segmented.
    #[arg(long, hide = true)]
    pub(crate) pixels: Option<PathBuf>,
}

#[derive(Args)]
pub(crate) struct ExecJob {
    #[arg(long)]
    pub(crate) input: PathBuf,
    #[arg(long)]
    pub(crate) plan: PathBuf,
    #[arg(long)]
    pub(crate) out: PathBuf,
    #[arg(long)]
    pub(crate) earlier: Option<PathBuf>,
    #[arg(long, default_value_t = 0)]
    pub(crate) threads: usize,
}

#[derive(Args)]
pub(crate) struct Phantom {
    /// anastomosis, tube, helix, trifurcation, or random (drawn from the seed).
    pub(crate) kind: String,
    /// Folder to write.
    #[arg(long)]
    pub(crate) out: PathBuf,
    #[command(flatten)]
    pub(crate) image: Image,
}

/// What of a simulated scan may be set.
#[derive(Args, Default)]
pub(crate) struct Image {
    /// Noise (and, for `random`, the shape).
    #[arg(long)]
    pub(crate) seed: Option<u64>,
    /// Contrast of lumen against tissue over the noise's sigma.
    #[arg(long)]
    pub(crate) snr: Option<f64>,
    /// Pixels per row and rows per slice.
    #[arg(long)]
    pub(crate) size: Option<usize>,
    /// Number of slices.
    #[arg(long)]
    pub(crate) slices: Option<usize>,
    /// Pixel size, mm.
    #[arg(long)]
    pub(crate) pixel: Option<f64>,
    /// Distance between slices, mm.
    #[arg(long)]
    pub(crate) spacing: Option<f64>,
    /// Slice thickness, mm (default: the spacing).
    #[arg(long)]
    pub(crate) thickness: Option<f64>,
    /// Unrelated bright vessels.
    #[arg(long)]
    pub(crate) distractors: Option<usize>,
    /// Turn the vessel against the slices, degrees.
    #[arg(long)]
    pub(crate) tilt: Option<f64>,
    /// Slices to leave out, by number, separated by commas.
    #[arg(long, value_delimiter = ',')]
    pub(crate) missing: Vec<usize>,
}

#[derive(Args)]
pub(crate) struct Demo {
    /// Folder for the artefacts.
    #[arg(long, default_value = "demo")]
    pub(crate) out: PathBuf,
    /// Noise seed.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// Keep the service running afterwards (the default when a person is at the terminal).
    #[arg(long)]
    pub(crate) keep: bool,
}

/// An origin as a browser writes it, and nothing that could say more in a header.
fn origin(text: &str) -> Result<String, String> {
    let host = text.strip_prefix("https://").or_else(|| text.strip_prefix("http://")).unwrap_or_default();
    let plain = host.bytes().all(|b| b.is_ascii_alphanumeric() || b"-.:[]*".contains(&b));
    if host.is_empty() || !plain {
        return Err("give an origin such as https://portal.example.org".to_owned());
    }
    Ok(text.to_owned())
}
