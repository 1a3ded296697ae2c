//! Resumable uploads on disk: bytes that nobody can read without the upload's address.
//!
//! What a client sends is not de-identified before it is whole, and nothing that names a patient may touch the disk. So the
//! parts are sealed (ChaCha20-Poly1305) under a key that is half of the upload's address: the client has it, the table and
//! the disk do not. A stolen disk, a backup or the operator's `strings` shows noise; a server that was killed goes on
//! where it stood. Rejected: keys in memory only (a restart would cost every upload), keys in the table (beside the data).
//!
//! A file is a row of frames, `length | nonce | sealed bytes`, the first of which holds the file's name. The offset is what
//! the whole frames hold: a frame torn by a kill is cut off when the upload goes on. Limits: the file lies on the server
//! that made it, so behind several servers the addresses of one upload must lead to one of them.

use crate::db::{Db, Scope, args};
use crate::store::hex;
use ring::aead::{Aad, CHACHA20_POLY1305, LessSafeKey, Nonce, UnboundKey};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Error, ErrorKind, Read as _, Result, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;
use uuid::Uuid;

/// Most plain bytes of a frame. At 256 KiB 50 uploads took 63 MiB together (the bar is 64).
pub(crate) const FRAME: usize = 64 << 10;
/// Uploads that a tenant may have open at the same time.
pub(crate) const MOST: i64 = 64;
/// How long an upload may take, and an unused one stays, ms.
const LIFE_MS: i64 = 24 * 3600 * 1000;
/// How long an upload stays after a job took it, so that a client whose answer was lost may ask again, ms.
const AFTERLIFE_MS: i64 = 10 * 60 * 1000;
/// A file without a row may belong to an upload that is being made.
const YOUNG: Duration = Duration::from_secs(3600);
const LENGTH: usize = 4;
const NONCE: usize = 12;
const TAG: usize = 16;

/// The address of an upload: its id, by which it is known here, and its key, which is kept nowhere.
#[derive(Clone, PartialEq, Eq)]
pub(crate) struct Ticket {
    pub id: Uuid,
    key: [u8; 32],
}

impl Ticket {
    /// A new one.
    pub(crate) fn new() -> std::result::Result<Self, getrandom::Error> {
        let mut key = [0; 32];
        getrandom::fill(&mut key)?;
        Ok(Self { id: Uuid::now_v7(), key })
    }

    /// The ticket of 96 hex digits.
    pub(crate) fn of(text: &str) -> Option<Self> {
        if text.len() != 96 || !text.bytes().all(|b| b.is_ascii_hexdigit()) {
            return None;
        }
        let mut key = [0; 32];
        for (byte, digits) in key.iter_mut().zip(text.as_bytes()[32..].chunks(2)) {
            *byte = u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?;
        }
        Some(Self { id: Uuid::parse_str(&text[..32]).ok()?, key })
    }

    /// 96 hex digits.
    pub(crate) fn text(&self) -> String {
        format!("{}{}", self.id.simple(), hex(&self.key))
    }

    fn cipher(&self) -> Result<LessSafeKey> {
        let key = UnboundKey::new(&CHACHA20_POLY1305, &self.key).map_err(|_| Error::other("no cipher"))?;
        Ok(LessSafeKey::new(key))
    }

    fn path(&self, folder: &Path) -> PathBuf {
        folder.join(self.id.to_string())
    }
}

/// Where the uploads of a data folder lie.
pub(crate) fn folder(data_dir: &Path) -> PathBuf {
    data_dir.join("uploads")
}

/// A file that is being written or read.
pub(crate) struct Partial {
    file: File,
    cipher: LessSafeKey,
    id: Uuid,
    frames: u64,
    /// Bytes of the file in whole frames.
    end: u64,
    /// Bytes of the upload.
    pub offset: u64,
    /// Cut back to this many bytes of the file unless told otherwise.
    undo: Option<u64>,
}

impl Partial {
    /// Makes the file of a new upload and seals its name into it.
    pub(crate) fn create(folder: &Path, ticket: &Ticket, name: &str) -> Result<()> {
        std::fs::create_dir_all(folder)?;
        let file = OpenOptions::new().read(true).write(true).create_new(true).open(ticket.path(folder))?;
        let mut partial =
            Self { file, cipher: ticket.cipher()?, id: ticket.id, frames: 0, end: 0, offset: 0, undo: None };
        partial.append(name.as_bytes())?;
        partial.file.sync_all()
    }

    /// Opens an upload to go on with it. `WouldBlock`: another request writes it; `NotFound`: no such upload here.
    pub(crate) fn open(folder: &Path, ticket: &Ticket) -> Result<Self> {
        let file = OpenOptions::new().read(true).write(true).open(ticket.path(folder))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(ErrorKind::WouldBlock.into()),
            Err(TryLockError::Error(error)) => return Err(error),
        }
        let mut partial = Self::measured(file, ticket)?;
        partial.file.set_len(partial.end)?;
        partial.file.seek(SeekFrom::Start(partial.end))?;
        Ok(partial)
    }

    /// How much of an upload is there.
    pub(crate) fn offset(folder: &Path, ticket: &Ticket) -> Result<u64> {
        Ok(Self::measured(File::open(ticket.path(folder))?, ticket)?.offset)
    }

    /// Walks over the whole frames. The first one opens only with the right key.
    fn measured(file: File, ticket: &Ticket) -> Result<Self> {
        let length = file.metadata()?.len();
        let mut partial =
            Self { file, cipher: ticket.cipher()?, id: ticket.id, frames: 0, end: 0, offset: 0, undo: None };
        partial.frame()?.ok_or(ErrorKind::NotFound)?;
        loop {
            let mut head = [0; LENGTH];
            if partial.file.read_exact(&mut head).is_err() {
                break;
            }
            let plain = u64::from(u32::from_le_bytes(head));
            let end = partial.end + (LENGTH + NONCE + TAG) as u64 + plain;
            if end > length {
                break;
            }
            partial.end = end;
            partial.frames += 1;
            partial.offset += plain;
            partial.file.seek(SeekFrom::Start(end))?;
        }
        Ok(partial)
    }

    /// Seals bytes behind the others; at most [`FRAME`].
    pub(crate) fn append(&mut self, plain: &[u8]) -> Result<()> {
        let mut nonce = [0; NONCE];
        getrandom::fill(&mut nonce).map_err(|_| Error::other("no random bytes"))?;
        let length = u32::try_from(plain.len()).map_err(|_| Error::other("a frame is too large"))?;
        let mut sealed = plain.to_vec();
        self.cipher
            .seal_in_place_append_tag(Nonce::assume_unique_for_key(nonce), self.aad(), &mut sealed)
            .map_err(|_| Error::other("a frame cannot be sealed"))?;
        let frame = [&length.to_le_bytes()[..], &nonce, &sealed].concat();
        self.file.write_all(&frame)?;
        if self.frames > 0 {
            self.offset += plain.len() as u64;
        }
        self.frames += 1;
        self.end += frame.len() as u64;
        Ok(())
    }

    /// Whatever is appended from now on is taken back unless [`Partial::keep`] is called.
    pub(crate) fn on_trial(&mut self) {
        self.undo = Some(self.end);
    }

    /// Keeps what was appended on trial.
    pub(crate) fn keep(&mut self) {
        self.undo = None;
    }

    /// Brings everything to the disk.
    pub(crate) fn sync(&self) -> Result<()> {
        self.file.sync_data()
    }

    /// The file's name and bytes.
    pub(crate) fn read(mut self) -> Result<(String, Vec<u8>)> {
        let mut bytes = Vec::with_capacity(usize::try_from(self.offset).unwrap_or_default());
        self.file.seek(SeekFrom::Start(0))?;
        (self.frames, self.end) = (0, 0);
        let name = self.frame()?.ok_or(ErrorKind::NotFound)?;
        while let Some(frame) = self.frame()? {
            bytes.extend_from_slice(&frame);
        }
        Ok((String::from_utf8_lossy(&name).into_owned(), bytes))
    }

    /// The next frame, opened; `None` at the end.
    fn frame(&mut self) -> Result<Option<Vec<u8>>> {
        let mut head = [0; LENGTH + NONCE];
        match self.file.read_exact(&mut head) {
            Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(None),
            other => other?,
        }
        let length = u32::from_le_bytes([head[0], head[1], head[2], head[3]]) as usize;
        if length > FRAME {
            return Err(ErrorKind::InvalidData.into());
        }
        let mut nonce = [0; NONCE];
        nonce.copy_from_slice(&head[LENGTH..]);
        let mut sealed = vec![0; length + TAG];
        self.file.read_exact(&mut sealed)?;
        let opened = self.cipher.open_in_place(Nonce::assume_unique_for_key(nonce), self.aad(), &mut sealed);
        // Of the first frame: another key. Of a later one: the disk gave back something else.
        let wrong = if self.frames == 0 { ErrorKind::NotFound } else { ErrorKind::InvalidData };
        opened.map_err(|_| Error::from(wrong))?;
        sealed.truncate(length);
        self.frames += 1;
        self.end += (LENGTH + NONCE + TAG + length) as u64;
        Ok(Some(sealed))
    }

    /// Binds a frame to its place: frames cannot be swapped, nor moved to another upload.
    fn aad(&self) -> Aad<[u8; 24]> {
        let mut place = [0; 24];
        place[..16].copy_from_slice(self.id.as_bytes());
        place[16..].copy_from_slice(&self.frames.to_le_bytes());
        Aad::from(place)
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        if let Some(length) = self.undo {
            // A cut that fails leaves bytes that the client's next offset does not fit: it hears 409 and asks again.
            let _ = self.file.set_len(length);
        }
    }
}

/// Writes an upload into the table; `false` when the tenant has too many.
pub(crate) async fn add(db: &Db, tenant: &str, id: Uuid, bytes: i64) -> sqlx::Result<bool> {
    let sql = "INSERT INTO upload (id, tenant, bytes, name, created_at, expires_at) \
               SELECT $1, $2, $3, '', now_ms(), now_ms() + $4 \
               WHERE (SELECT COUNT(*) FROM upload WHERE tenant = $2 AND expires_at > now_ms()) < $5";
    Ok(db.run(Scope::Tenant(tenant), sql, args![id, tenant, bytes, LIFE_MS, MOST]).await? > 0)
}

/// Length and time of expiry of an upload that has not expired.
pub(crate) async fn find(db: &Db, tenant: &str, id: Uuid) -> sqlx::Result<Option<(u64, i64)>> {
    let sql = "SELECT bytes, expires_at FROM upload WHERE id = $1 AND tenant = $2 AND expires_at > now_ms()";
    let Some(row) = db.row(Scope::Tenant(tenant), sql, args![id, tenant]).await? else { return Ok(None) };
    Ok(Some((u64::try_from(row.get::<i64>("bytes")?).unwrap_or(0), row.get("expires_at")?)))
}

/// A job took the upload: it goes soon.
pub(crate) async fn used(db: &Db, tenant: &str, id: Uuid) -> sqlx::Result<()> {
    let sql = "UPDATE upload SET expires_at = now_ms() + $3 WHERE id = $1 AND tenant = $2";
    db.run(Scope::Tenant(tenant), sql, args![id, tenant, AFTERLIFE_MS]).await?;
    Ok(())
}

/// Erases an upload.
pub(crate) async fn remove(db: &Db, data_dir: &Path, tenant: &str, id: Uuid) -> anyhow::Result<bool> {
    let sql = "DELETE FROM upload WHERE id = $1 AND tenant = $2";
    let gone = db.run(Scope::Tenant(tenant), sql, args![id, tenant]).await? > 0;
    erase(&folder(data_dir).join(id.to_string()))?;
    Ok(gone)
}

fn erase(path: &Path) -> Result<()> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// Erases uploads past their time, and files that no row names.
pub(crate) async fn retire(db: &Db, data_dir: &Path) -> anyhow::Result<()> {
    db.run(Scope::System, "DELETE FROM upload WHERE expires_at <= now_ms()", Vec::new()).await?;
    let Ok(entries) = std::fs::read_dir(folder(data_dir)) else { return Ok(()) };
    for entry in entries.flatten() {
        let id = entry.file_name().to_str().and_then(|name| Uuid::parse_str(name).ok());
        let known = match id {
            Some(id) => db.row(Scope::System, "SELECT id FROM upload WHERE id = $1", args![id]).await?.is_some(),
            None => false,
        };
        let age = entry.metadata().and_then(|m| m.modified()).ok().and_then(|at| at.elapsed().ok());
        let made = id.map(|id| Duration::from_millis(u64::try_from(id.as_u128() >> 80).unwrap_or(0)));
        let since = made
            .and_then(|at| std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).ok()?.checked_sub(at));
        if !known && age.max(since).is_some_and(|age| age >= YOUNG) {
            erase(&entry.path())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_torn_frame_is_cut_off_and_the_rest_reads_back() {
        let folder = tempfile::TempDir::new().unwrap();
        let ticket = Ticket::new().unwrap();
        assert!(Ticket::of(&ticket.text()).unwrap() == ticket);
        Partial::create(folder.path(), &ticket, "scan.zip").unwrap();
        let mut partial = Partial::open(folder.path(), &ticket).unwrap();
        assert_eq!(Partial::open(folder.path(), &ticket).err().unwrap().kind(), ErrorKind::WouldBlock);
        partial.append(b"patient's name").unwrap();
        drop(partial);
        let path = ticket.path(folder.path());
        let whole = std::fs::read(&path).unwrap();
        assert!(!whole.windows(7).any(|w| w == b"patient"), "sealed");
        for torn in [1, 4, 16, 20] {
            std::fs::write(&path, [&whole[..], &whole[..torn]].concat()).unwrap();
            assert_eq!(Partial::offset(folder.path(), &ticket).unwrap(), 14);
            let partial = Partial::open(folder.path(), &ticket).unwrap();
            assert_eq!(partial.read().unwrap(), ("scan.zip".to_owned(), b"patient's name".to_vec()));
        }
        let mut partial = Partial::open(folder.path(), &ticket).unwrap();
        partial.on_trial();
        partial.append(b"more").unwrap();
        drop(partial);
        assert_eq!(Partial::offset(folder.path(), &ticket).unwrap(), 14);
        let other = Ticket { key: [1; 32], ..ticket };
        assert_eq!(Partial::offset(folder.path(), &other).err().unwrap().kind(), ErrorKind::NotFound);
    }
}
