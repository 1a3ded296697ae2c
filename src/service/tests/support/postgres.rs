//! A PostgreSQL of the test's own: Debian's binaries, a cluster in a temporary folder, a socket and no port.

use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

/// Runs the cluster as a user that is not root, ends it and removes the folder when its input closes.
const KEEPER: &str = r#"
set -e
bin=$1; dir=$2
as() { if [ "$(id -u)" = 0 ]; then runuser -u postgres -- "$@"; else "$@"; fi; }
if [ "$(id -u)" = 0 ]; then chown postgres "$dir"; fi
cd "$dir"
as "$bin/initdb" -D "$dir/data" -U postgres -A trust --locale=C -E UTF8 >/dev/null
as "$bin/pg_ctl" -D "$dir/data" -w -l "$dir/log" -o "-k $dir -c listen_addresses= -c max_connections=300 $3" start >/dev/null
echo ready
while read -r word; do
  if [ "$word" = crash ]; then
    as "$bin/pg_ctl" -D "$dir/data" -m immediate stop >/dev/null
    as "$bin/pg_ctl" -D "$dir/data" -w -l "$dir/log" -o "-k $dir -c listen_addresses= -c max_connections=300 $3" start >/dev/null
    echo ready
  fi
done
as "$bin/pg_ctl" -D "$dir/data" -m immediate stop >/dev/null || true
rm -rf "$dir"
"#;

pub struct Cluster {
    pub folder: PathBuf,
    bin: PathBuf,
    keeper: std::sync::Mutex<Child>,
}

/// Where Debian keeps the server's programs.
fn programs() -> Option<PathBuf> {
    let mut found: Vec<PathBuf> = std::fs::read_dir("/usr/lib/postgresql")
        .ok()?
        .filter_map(|entry| Some(entry.ok()?.path().join("bin")))
        .filter(|bin| bin.join("initdb").exists())
        .collect();
    found.sort();
    found.pop()
}

/// The cluster of this test binary, or `None` where PostgreSQL is not installed (`cargo xtask test` installs it and
/// sets VASCULUM_POSTGRES, which makes its lack a failure).
pub fn cluster() -> Option<&'static Cluster> {
    static CLUSTER: OnceLock<Option<Cluster>> = OnceLock::new();
    CLUSTER
        .get_or_init(|| {
            let Some(bin) = programs() else {
                assert!(std::env::var_os("VASCULUM_POSTGRES").is_none(), "PostgreSQL is not installed");
                eprintln!("skipped: PostgreSQL is not installed");
                return None;
            };
            Some(start(bin))
        })
        .as_ref()
}

fn start(bin: PathBuf) -> Cluster {
    static NUMBER: AtomicU64 = AtomicU64::new(0);
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    // A socket's path must stay below 108 bytes.
    let folder = PathBuf::from(format!("/tmp/vpg-{}-{number}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let mut keeper = Command::new("bash")
        .args(["-c", KEEPER, "keeper"])
        .args([&bin, &folder])
        .arg("")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::inherit())
        .spawn()
        .unwrap();
    ready(&mut keeper);
    Cluster { folder, bin, keeper: std::sync::Mutex::new(keeper) }
}

fn ready(keeper: &mut Child) {
    let mut word = [0_u8; 6];
    keeper.stdout.as_mut().unwrap().read_exact(&mut word).unwrap();
    assert_eq!(&word, b"ready\n");
}

impl Cluster {
    /// SQL as the superuser.
    pub fn sql(&self, database: &str, sql: &str) -> String {
        let out = Command::new(self.bin.join("psql"))
            .args(["-X", "-q", "-t", "-A", "-v", "ON_ERROR_STOP=1", "-U", "postgres", "-d", database, "-c", sql])
            .arg("-h")
            .arg(&self.folder)
            .output()
            .unwrap();
        assert!(out.status.success(), "{sql}: {}", String::from_utf8_lossy(&out.stderr));
        String::from_utf8(out.stdout).unwrap().trim().to_owned()
    }

    /// Stops at once as a loss of power would, and starts again.
    pub fn crash(&self) {
        let mut keeper = self.keeper.lock().unwrap();
        keeper.stdin.as_mut().unwrap().write_all(b"crash\n").unwrap();
        ready(&mut keeper);
    }

    /// A new database that belongs to the service's role, which is no superuser.
    pub fn database(&self) -> String {
        static NUMBER: AtomicU64 = AtomicU64::new(0);
        static ROLE: OnceLock<()> = OnceLock::new();
        ROLE.get_or_init(|| {
            self.sql("postgres", "CREATE ROLE vasculum LOGIN");
        });
        let name = format!("v{}", NUMBER.fetch_add(1, Ordering::Relaxed));
        self.sql("postgres", &format!("CREATE DATABASE {name} OWNER vasculum"));
        url(&self.folder, &name)
    }
}

fn url(folder: &Path, database: &str) -> String {
    format!("postgres://vasculum@localhost/{database}?host={}", folder.display())
}
