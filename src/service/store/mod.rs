//! The artefact store: object keys and bytes, on a local folder with fsync or in any S3.
//!
//! Keys: `jobs/<id>/input/<digest>` with a manifest beside them, named by its own digest too, so that an input that
//! grows (DICOMweb) never overwrites what the job table names, and `jobs/<id>/artefacts/<fence>/<name>`. The fence in
//! the key keeps a worker that lost its lease from overwriting the files of the one that holds it. An object exists
//! for readers only once the job table names it; whatever else lies here is an orphan and is swept at start.

use crate::config::{Config, StorePlace};
use futures::{StreamExt as _, TryStreamExt as _};
use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::prefix::PrefixStore;
use object_store::{ClientOptions, MultipartUpload, ObjectStore, ObjectStoreExt as _, RetryConfig};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use std::path::Path;
use std::str::FromStr as _;
use std::sync::Arc;
use std::time::Duration;
use uuid::Uuid;

/// How long one request to S3 is tried again (S3 answers 500 and 503 under load); beyond it the caller hears 503.
const S3_PATIENCE: Duration = Duration::from_secs(20);
/// An answer of S3, or the next bytes of it, that takes longer is asked for again, on another connection: one that stands may
/// stand for ever. There is no bound on a whole request, which a large object over a slow line would meet.
const S3_SILENCE: Duration = Duration::from_secs(10);
/// Larger objects go to S3 in parts of this size, each a request of its own whose answer must come within [`S3_SILENCE`]: at
/// .8 MB/s. S3 takes parts of 5 MiB and more.
const S3_PART: usize = 8 << 20;

/// What the store can answer.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The store's own error.
    #[error("artefact store: {0}")]
    Store(#[from] object_store::Error),
    /// A stored object is not what was put there.
    #[error("stored object {key} has digest {found} instead of {wanted}")]
    Digest {
        /// Object key.
        key: String,
        /// Digest of the bytes.
        found: String,
        /// Digest that was recorded.
        wanted: String,
    },
    /// The manifest of an input cannot be read.
    #[error("manifest of job {job}: {source}")]
    Manifest {
        /// Job id.
        job: Uuid,
        /// Why.
        source: serde_json::Error,
    },
    /// A file of this machine.
    #[error("{0}")]
    Io(#[from] std::io::Error),
}

impl Error {
    /// Whether the store did not answer, or not well: asked again later, it may.
    pub fn is_away(&self) -> bool {
        matches!(self, Self::Store(error) if !matches!(error, object_store::Error::NotFound { .. }))
    }
}

/// One input file in the manifest.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputFile {
    /// Harmless name.
    pub name: String,
    /// Size.
    pub bytes: u64,
    /// `sha256:...`.
    pub digest: String,
}

/// A stored input.
#[derive(Clone, Debug)]
pub struct Input {
    /// `sha256:` of the manifest, which holds name, size and digest of every file.
    pub digest: String,
    /// Files, in order.
    pub files: Vec<InputFile>,
}

impl Input {
    /// The input of these files.
    pub fn of(files: Vec<InputFile>) -> Self {
        Self { digest: digest(&manifest_bytes(&files)), files }
    }

    /// Size of all files together.
    pub fn bytes(&self) -> u64 {
        self.files.iter().map(|file| file.bytes).sum()
    }
}

/// The store. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Store {
    objects: Arc<dyn ObjectStore>,
    /// The folder of a local store. A `kill -9` between writing and renaming leaves `NAME#1`, which object_store neither
    /// lists nor deletes (the kill storm found scans that outlived their erasure so): folders are read and removed here.
    folder: Option<std::path::PathBuf>,
}

/// `sha256:` and 64 hex digits.
pub fn digest(bytes: &[u8]) -> String {
    format!("sha256:{}", hex(&Sha256::digest(bytes)))
}

/// Lower-case hex digits.
pub fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write as _;
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, byte| {
        // Writing into a String cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

fn job_prefix(job: Uuid) -> Key {
    Key::from_iter(["jobs", &job.to_string()])
}

/// The key of a file of an input, by its digest.
fn input_key(job: Uuid, digest: &str) -> Key {
    Key::from_iter(["jobs", &job.to_string(), "input", hex_of(digest)])
}

fn manifest_key(job: Uuid, digest: &str) -> Key {
    Key::from_iter(["jobs", &job.to_string(), "input", &format!("manifest-{}.json", hex_of(digest))])
}

fn hex_of(digest: &str) -> &str {
    digest.strip_prefix("sha256:").unwrap_or(digest)
}

impl Store {
    /// The configured store.
    ///
    /// # Errors
    /// The folder cannot be made; an address or a setting that is not understood.
    pub fn open(config: &Config) -> anyhow::Result<Self> {
        match config.store_place()? {
            StorePlace::Folder(folder) => Ok(Self::local(&folder)?),
            StorePlace::S3 { bucket, prefix } => Self::s3(&bucket, &prefix, &config.s3),
        }
    }

    /// A store in a bucket. S3 answers a put after the object is durable.
    fn s3(bucket: &str, prefix: &str, settings: &[(String, String)]) -> anyhow::Result<Self> {
        crate::tls::provide();
        let retry = RetryConfig { retry_timeout: S3_PATIENCE, ..RetryConfig::default() };
        let mut builder = AmazonS3Builder::new()
            .with_client_options(ClientOptions::new().with_timeout_disabled().with_read_timeout(S3_SILENCE))
            .with_bucket_name(bucket)
            .with_retry(retry)
            .with_checksum_algorithm(object_store::aws::Checksum::SHA256);
        for (name, value) in settings {
            let name = format!("aws_{}", name.to_ascii_lowercase());
            let key = AmazonS3ConfigKey::from_str(&name)
                .map_err(|_| anyhow::anyhow!("there is no setting {name} of an S3 store"))?;
            builder = builder.with_config(key, value);
            if name == "aws_endpoint" && value.starts_with("http://") {
                builder = builder.with_allow_http(true);
            }
        }
        let objects: Arc<dyn ObjectStore> = match prefix {
            "" => Arc::new(builder.build()?),
            prefix => Arc::new(PrefixStore::new(builder.build()?, prefix)),
        };
        Ok(Self { objects, folder: None })
    }

    /// A store in a folder of this machine, made if missing; every put is synced to disk before it returns.
    ///
    /// # Errors
    /// The folder cannot be made or opened.
    pub fn local(folder: &Path) -> Result<Self, Error> {
        std::fs::create_dir_all(folder)?;
        let objects = LocalFileSystem::new_with_prefix(folder)?.with_fsync(true).with_automatic_cleanup(true);
        Ok(Self { objects: Arc::new(objects), folder: Some(folder.to_owned()) })
    }

    /// Digests of an input's files and of its manifest, without storing anything.
    pub fn describe(files: &[(String, Vec<u8>)]) -> Input {
        let files = files
            .iter()
            .map(|(name, bytes)| InputFile { name: name.clone(), bytes: bytes.len() as u64, digest: digest(bytes) })
            .collect();
        Input::of(files)
    }

    /// Stores the files of an input, or those that are new in it, and then its manifest, so that a manifest means a whole
    /// input.
    ///
    /// # Errors
    /// The store's.
    pub async fn put_input(&self, job: Uuid, input: &Input, files: Vec<(String, Vec<u8>)>) -> Result<(), Error> {
        for (_, bytes) in files {
            self.put(&input_key(job, &digest(&bytes)), bytes).await?;
        }
        self.put(&manifest_key(job, &input.digest), manifest_bytes(&input.files)).await?;
        Ok(())
    }

    /// The files of a stored input.
    ///
    /// # Errors
    /// The store's; a digest that does not match.
    pub async fn manifest(&self, job: Uuid, wanted: &str) -> Result<Vec<InputFile>, Error> {
        let manifest = self.verified(&manifest_key(job, wanted), wanted).await?;
        serde_json::from_slice(&manifest).map_err(|source| Error::Manifest { job, source })
    }

    /// Writes a stored input into a folder of this machine, each file under its harmless name, digests checked.
    ///
    /// # Errors
    /// The store's; a digest that does not match.
    pub async fn fetch_input(&self, job: Uuid, wanted: &str, folder: &Path) -> Result<(), Error> {
        for file in self.manifest(job, wanted).await? {
            let bytes = self.verified(&input_key(job, &file.digest), &file.digest).await?;
            tokio::fs::write(folder.join(&file.name), &bytes).await?;
        }
        Ok(())
    }

    /// A stored input in memory, digests checked.
    ///
    /// # Errors
    /// The store's; a digest that does not match.
    pub async fn input(&self, job: Uuid, wanted: &str) -> Result<Vec<(String, Vec<u8>)>, Error> {
        let mut read = Vec::new();
        for file in self.manifest(job, wanted).await? {
            let bytes = self.verified(&input_key(job, &file.digest), &file.digest).await?;
            read.push((file.name, bytes.into()));
        }
        Ok(read)
    }

    async fn verified(&self, key: &Key, wanted: &str) -> Result<bytes::Bytes, Error> {
        let bytes = self.objects.get(key).await?.bytes().await?;
        let found = digest(&bytes);
        if found != wanted {
            return Err(Error::Digest { key: key.to_string(), found, wanted: wanted.to_owned() });
        }
        Ok(bytes)
    }

    /// Stores an artefact of a job's attempt; returns its key and digest.
    ///
    /// # Errors
    /// The store's.
    pub async fn put_artefact(
        &self,
        job: Uuid,
        fence: i64,
        name: &str,
        bytes: Vec<u8>,
    ) -> Result<(String, String), Error> {
        let key = Key::from_iter(["jobs", &job.to_string(), "artefacts", &fence.to_string(), name]);
        let digest = digest(&bytes);
        self.put(&key, bytes).await?;
        Ok((key.to_string(), digest))
    }

    /// Stores an object, in parts where it is large and the store is far.
    async fn put(&self, key: &Key, bytes: Vec<u8>) -> Result<(), Error> {
        if self.folder.is_some() || bytes.len() <= S3_PART {
            self.objects.put(key, bytes.into()).await?;
            return Ok(());
        }
        let mut upload = self.objects.put_multipart(key).await?;
        let sent = in_parts(upload.as_mut(), bytes.into()).await;
        if sent.is_err() {
            // What this cannot take back, the bucket's rule for broken-off uploads does (docs/runbook.md).
            let _ = tokio::time::timeout(S3_SILENCE, upload.abort()).await;
        }
        Ok(sent?)
    }

    /// Streams the bytes `range` of an object.
    ///
    /// # Errors
    /// The store's.
    pub async fn stream(
        &self,
        key: &str,
        range: std::ops::Range<u64>,
    ) -> Result<futures::stream::BoxStream<'static, object_store::Result<bytes::Bytes>>, Error> {
        if range.is_empty() {
            return Ok(futures::stream::empty().boxed());
        }
        let options = object_store::GetOptions { range: Some(range.into()), ..Default::default() };
        Ok(self.objects.get_opts(&Key::from(key), options).await?.into_stream())
    }

    /// Streams a whole object of `bytes` bytes and checks its digest on the way: the last part is held back until the
    /// digest is known to be right, so that a reader of a damaged object sees the transfer break off, never a whole file.
    ///
    /// # Errors
    /// The store's.
    pub async fn whole(
        &self,
        key: &str,
        digest: &str,
    ) -> Result<futures::stream::BoxStream<'static, Result<bytes::Bytes, Error>>, Error> {
        let parts = self.objects.get(&Key::from(key)).await?.into_stream();
        let check = Check { parts, hasher: Sha256::new(), held: None, key: key.to_owned(), wanted: digest.to_owned() };
        Ok(futures::stream::try_unfold(Some(check), |check| async move {
            let Some(check) = check else { return Ok(None) };
            check.next().await
        })
        .boxed())
    }

    /// A whole object.
    ///
    /// # Errors
    /// The store's; a digest that does not match.
    pub async fn bytes(&self, key: &str, digest: &str) -> Result<bytes::Bytes, Error> {
        self.verified(&Key::from(key), digest).await
    }

    /// Erases everything of a job.
    ///
    /// # Errors
    /// The store's.
    pub async fn erase_job(&self, job: Uuid) -> Result<(), Error> {
        self.erase(job_prefix(job)).await
    }

    /// Erases what one attempt stored.
    ///
    /// # Errors
    /// The store's.
    pub async fn erase_attempt(&self, job: Uuid, fence: i64) -> Result<(), Error> {
        self.erase(Key::from_iter(["jobs", &job.to_string(), "artefacts", &fence.to_string()])).await
    }

    async fn erase(&self, prefix: Key) -> Result<(), Error> {
        if let Some(folder) = &self.folder {
            return match tokio::fs::remove_dir_all(folder.join(prefix.as_ref())).await {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(error.into()),
                _ => Ok(()),
            };
        }
        let found = self.objects.list(Some(&prefix)).map_ok(|meta| meta.location).boxed();
        let mut deleted = self.objects.delete_stream(found);
        while let Some(one) = deleted.next().await {
            match one {
                // Erased by somebody else at the same moment: gone is what was wanted.
                Ok(_) | Err(object_store::Error::NotFound { .. }) => {}
                Err(other) => return Err(other.into()),
            }
        }
        Ok(())
    }

    /// Ids of all jobs of which something is stored.
    ///
    /// # Errors
    /// The store's.
    pub async fn jobs(&self) -> Result<Vec<Uuid>, Error> {
        let names = self.folders(&Key::from("jobs")).await?;
        Ok(names.iter().filter_map(|name| Uuid::parse_str(name).ok()).collect())
    }

    /// Fences under which something of a job is stored.
    ///
    /// # Errors
    /// The store's.
    pub async fn attempts(&self, job: Uuid) -> Result<Vec<i64>, Error> {
        let prefix = Key::from_iter(["jobs", &job.to_string(), "artefacts"]);
        Ok(self.folders(&prefix).await?.iter().filter_map(|name| name.parse().ok()).collect())
    }

    /// Names one level below a prefix.
    async fn folders(&self, prefix: &Key) -> Result<Vec<String>, Error> {
        let Some(folder) = &self.folder else {
            let listed = self.objects.list_with_delimiter(Some(prefix)).await?;
            return Ok(listed.common_prefixes.iter().filter_map(|key| Some(key.filename()?.to_owned())).collect());
        };
        let mut entries = match tokio::fs::read_dir(folder.join(prefix.as_ref())).await {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
            entries => entries?,
        };
        let mut names = Vec::new();
        while let Some(entry) = entries.next_entry().await? {
            names.push(entry.file_name().to_string_lossy().into_owned());
        }
        Ok(names)
    }

    /// Puts and removes a small object: whether the store takes writes.
    ///
    /// # Errors
    /// The store's.
    pub async fn probe(&self) -> Result<(), Error> {
        let key = Key::from(format!("probe/{}", Uuid::now_v7()));
        self.objects.put(&key, "vasculum".into()).await?;
        self.objects.delete(&key).await?;
        Ok(())
    }
}

async fn in_parts(upload: &mut dyn MultipartUpload, mut rest: bytes::Bytes) -> object_store::Result<()> {
    while !rest.is_empty() {
        let part = rest.split_to(rest.len().min(S3_PART));
        upload.put_part(part.into()).await?;
    }
    upload.complete().await?;
    Ok(())
}

/// A stream that is hashed while it passes.
struct Check {
    parts: futures::stream::BoxStream<'static, object_store::Result<bytes::Bytes>>,
    hasher: Sha256,
    held: Option<bytes::Bytes>,
    key: String,
    wanted: String,
}

impl Check {
    /// The next part and the rest of the stream.
    async fn next(mut self) -> Result<Option<(bytes::Bytes, Option<Self>)>, Error> {
        while let Some(part) = self.parts.next().await {
            let part = part?;
            self.hasher.update(&part);
            if let Some(ready) = self.held.replace(part) {
                return Ok(Some((ready, Some(self))));
            }
        }
        let found = format!("sha256:{}", hex(&self.hasher.finalize()));
        if found != self.wanted {
            return Err(Error::Digest { key: self.key, found, wanted: self.wanted });
        }
        Ok(self.held.map(|last| (last, None)))
    }
}

fn manifest_bytes(files: &[InputFile]) -> Vec<u8> {
    // Strings and numbers always serialise; an empty manifest would fail its digest check.
    serde_json::to_vec(files).unwrap_or_default()
}
