//! Hostile uploads against the binary: the nine classes of the Orthanc advisories of 2026 (CVE-2026-5437 to -5445), and
//! archives, headers, texts and clients made to do harm. Each is refused with its own code within two seconds and 64 MiB,
//! and others are answered meanwhile.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod serving;

use serde_json::Value;
use std::fs;
use std::io::{Cursor, Read, Write};
use std::net::TcpStream;
use std::process::{Child, Command};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};
use tempfile::TempDir;
use zip::write::SimpleFileOptions;

/// Most memory that a refused upload may take beside its own bytes, MiB.
const MEMORY_MIB: u64 = 64;
const REFUSED_WITHIN: Duration = Duration::from_secs(2);
/// An answer to somebody else during an attack.
const ANSWERED_WITHIN: Duration = Duration::from_secs(1);
const EXPLICIT: &str = "1.2.840.10008.1.2.1";
const RLE: &str = "1.2.840.10008.1.2.5";

struct Server {
    process: Child,
    address: String,
    _data: TempDir,
}

impl Server {
    fn start() -> Self {
        let data = TempDir::new().unwrap();
        let (process, address) = serving::serve(env!("CARGO_BIN_EXE_vasculum").as_ref(), data.path(), |_| ());
        let address = address.trim_start_matches("http://").to_owned();
        Self { process, address, _data: data }
    }

    /// MiB of a line of /proc/PID/status.
    fn memory(&self, line: &str) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.process.id())).unwrap();
        let found = status.lines().find_map(|l| l.strip_prefix(line)).unwrap();
        found.split_whitespace().next().unwrap().parse::<u64>().unwrap() / 1024
    }

    /// Sends bytes and reads the answer: status and the problem's code (empty without a body).
    fn raw(&self, request: &[u8], body: &[u8]) -> (u16, String) {
        let mut stream = TcpStream::connect(&self.address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream.write_all(request).unwrap();
        // The service may answer and close before everything is sent.
        let _ = stream.write_all(body);
        answer(&mut stream)
    }

    fn post(&self, path: &str, headers: &str, body: &[u8]) -> (u16, String) {
        let head = format!(
            "POST {path} HTTP/1.1\r\nhost: {}\r\nconnection: close\r\ncontent-length: {}\r\n{headers}\r\n",
            self.address,
            body.len()
        );
        self.raw(head.as_bytes(), body)
    }

    /// Sends files as one upload.
    fn upload(&self, files: &[(&str, &[u8])]) -> (u16, String) {
        self.post(
            "/v1/jobs",
            "content-type: multipart/form-data; boundary=B\r\nprefer: wait=10\r\n",
            &multipart("input", files),
        )
    }

    fn plan(&self, text: &[u8]) -> (u16, String) {
        self.post(
            "/v1/jobs",
            "content-type: multipart/form-data; boundary=B\r\n",
            &multipart("plan", &[("p.json", text)]),
        )
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

fn multipart(part: &str, files: &[(&str, &[u8])]) -> Vec<u8> {
    let mut body = Vec::new();
    for (name, bytes) in files {
        let head = format!("--B\r\ncontent-disposition: form-data; name=\"{part}\"; filename=\"{name}\"\r\n\r\n");
        body.extend(head.as_bytes());
        body.extend(*bytes);
        body.extend(b"\r\n");
    }
    body.extend(b"--B--\r\n");
    body
}

fn answer(stream: &mut TcpStream) -> (u16, String) {
    let mut bytes = Vec::new();
    // A reset after the answer is no fault of the answer.
    let _ = stream.read_to_end(&mut bytes);
    let text = String::from_utf8_lossy(&bytes).into_owned();
    let status = text.split(' ').nth(1).and_then(|s| s.parse().ok()).unwrap_or(0);
    let body = text.split_once("\r\n\r\n").map_or("", |(_, body)| body);
    let problem: Value = serde_json::from_str(body).unwrap_or_default();
    // A job that was accepted and has failed meanwhile tells its code itself.
    let code = problem["code"].as_str().or(problem["error"]["code"].as_str());
    (status, code.unwrap_or_default().to_owned())
}

/// A DICOM element, explicit little endian.
fn element(tag: u32, vr: &str, value: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    out.extend(((tag >> 16) as u16).to_le_bytes());
    out.extend((tag as u16).to_le_bytes());
    out.extend(vr.as_bytes());
    if ["OB", "OW", "SQ", "UN"].contains(&vr) {
        out.extend([0, 0]);
        out.extend((value.len() as u32).to_le_bytes());
    } else {
        out.extend((value.len() as u16).to_le_bytes());
    }
    out.extend(value);
    out
}

fn dicom(syntax: &str, elements: &[Vec<u8>]) -> Vec<u8> {
    let mut text = syntax.as_bytes().to_vec();
    text.resize(text.len() + text.len() % 2, 0);
    let meta = element(0x0002_0010, "UI", &text);
    let mut out = vec![0; 128];
    out.extend(b"DICM");
    out.extend(element(0x0002_0000, "UL", &(meta.len() as u32).to_le_bytes()));
    out.extend(meta);
    elements.iter().for_each(|e| out.extend(e));
    out
}

/// A grey or palette image whose sizes are elements of the caller's.
fn image(photometric: &str, rows: Vec<u8>, columns: Vec<u8>, pixels: Vec<u8>) -> Vec<Vec<u8>> {
    let short = |tag, value: u16| element(tag, "US", &value.to_le_bytes());
    vec![
        element(0x0008_0016, "UI", b"1.2.840.10008.5.1.4.1.1.4\0"),
        short(0x0028_0002, 1),
        element(0x0028_0004, "CS", photometric.as_bytes()),
        rows,
        columns,
        element(0x0028_0030, "DS", b"1\\1 "),
        short(0x0028_0100, 8),
        short(0x0028_0101, 8),
        short(0x0028_0102, 7),
        short(0x0028_0103, 0),
        pixels,
    ]
}

fn size(tag: u32, value: u16) -> Vec<u8> {
    element(tag, "US", &value.to_le_bytes())
}

fn plain(tag: u32, vr: &str, bytes: &[u8]) -> Vec<u8> {
    element(tag, vr, bytes)
}

/// Encapsulated pixel data: an empty offset table and one fragment.
fn fragment(bytes: &[u8]) -> Vec<u8> {
    let mut out = vec![0xe0, 0x7f, 0x10, 0, b'O', b'B', 0, 0, 0xff, 0xff, 0xff, 0xff];
    out.extend([0xfe, 0xff, 0x00, 0xe0, 0, 0, 0, 0]);
    out.extend([0xfe, 0xff, 0x00, 0xe0]);
    out.extend((bytes.len() as u32).to_le_bytes());
    out.extend(bytes);
    out.extend([0xfe, 0xff, 0xdd, 0xe0, 0, 0, 0, 0]);
    out
}

fn zipped(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        zip.start_file(*name, SimpleFileOptions::default()).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

/// `count` zeros, gzipped.
fn gzip_of_zeros(mib: usize) -> Vec<u8> {
    let script = format!("import gzip,sys;sys.stdout.buffer.write(gzip.compress(bytes({mib}<<20)))");
    let out = Command::new("python3").args(["-c", &script]).output().unwrap();
    assert!(out.status.success());
    out.stdout
}

/// The zip with the size of its only entry told as `told` in both headers.
fn lying(told: u32) -> Vec<u8> {
    let mut zip = zipped(&[("scan.nii", &vec![0; 40 << 20])]);
    let central = zip.windows(4).rposition(|w| w == b"PK\x01\x02").unwrap();
    zip[central + 24..central + 28].copy_from_slice(&told.to_le_bytes());
    zip[22..26].copy_from_slice(&told.to_le_bytes());
    zip
}

/// A zip of `count` central entries that all name one local file; `told` is the count in its (small) end record.
fn crowded(count: u64, told: u16) -> Vec<u8> {
    let one = zipped(&[("a", b"x")]);
    let central = one.windows(4).rposition(|w| w == b"PK\x01\x02").unwrap();
    let end = one.windows(4).rposition(|w| w == b"PK\x05\x06").unwrap();
    let entry = one[central..end].to_vec();
    let mut zip = one[..central].to_vec();
    let begin = zip.len() as u64;
    (0..count).for_each(|_| zip.extend(&entry));
    let length = zip.len() as u64 - begin;
    let at = zip.len() as u64;
    // The zip64 end record, its locator, and the old end record.
    zip.extend(b"PK\x06\x06");
    zip.extend(44_u64.to_le_bytes());
    zip.extend([45, 0, 45, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    [count, count, length, begin].iter().for_each(|n| zip.extend(n.to_le_bytes()));
    zip.extend(b"PK\x06\x07");
    zip.extend(0_u32.to_le_bytes());
    zip.extend(at.to_le_bytes());
    zip.extend(1_u32.to_le_bytes());
    zip.extend(b"PK\x05\x06");
    zip.extend([0; 4]);
    zip.extend(told.to_le_bytes());
    zip.extend(told.to_le_bytes());
    zip.extend(u32::MAX.to_le_bytes());
    zip.extend(u32::MAX.to_le_bytes());
    zip.extend([0; 2]);
    zip
}

fn link() -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    zip.add_symlink("scan.dcm", "/etc/passwd", SimpleFileOptions::default()).unwrap();
    zip.finish().unwrap().into_inner()
}

/// Sends an attack; status and code of the answer.
type Send = Box<dyn Fn(&Server) -> (u16, String)>;

/// What an attack sends, and how it must be refused.
struct Attack {
    name: &'static str,
    /// Bytes of the upload, MiB: memory that the client pays for.
    own_mib: u64,
    send: Send,
    status: u16,
    codes: &'static [&'static str],
}

fn attack(
    name: &'static str,
    wanted: (u16, &'static [&'static str]),
    send: impl Fn(&Server) -> (u16, String) + 'static,
) -> Attack {
    Attack { name, own_mib: 0, send: Box::new(send), status: wanted.0, codes: wanted.1 }
}

/// An upload of one file.
fn file(name: &'static str, wanted: (u16, &'static [&'static str]), file: &'static str, bytes: Vec<u8>) -> Attack {
    let own_mib = (bytes.len() >> 20) as u64;
    Attack { own_mib, ..attack(name, wanted, move |server| server.upload(&[(file, &bytes)])) }
}

/// The nine classes of the advisories.
fn advisories() -> Vec<Attack> {
    let mut meta = vec![0; 128];
    meta.extend(b"DICM\x02\x00\x00\x00UL\x04\x00\xff\xff\xff\xff\x02\x00\x10\x00UI\xff\xff1.2");
    let long = |tag, value: u32| element(tag, "UL", &value.to_le_bytes());
    let dimensions = image(
        "MONOCHROME2 ",
        long(0x0028_0010, 0x8000_0001),
        long(0x0028_0011, 0x8000_0001),
        plain(0x7fe0_0010, "OW", &[0; 64]),
    );
    let overflow = image(
        "PALETTE COLOR ",
        size(0x0028_0010, 0xffff),
        size(0x0028_0011, 0xffff),
        plain(0x7fe0_0010, "OW", &[0; 64]),
    );
    let mut palette =
        image("PALETTE COLOR ", size(0x0028_0010, 8), size(0x0028_0011, 8), plain(0x7fe0_0010, "OW", &[0xff; 64]));
    palette.insert(10, element(0x0028_1101, "US", &[2, 0, 0, 0, 8, 0]));
    palette.insert(11, element(0x0028_1201, "OW", &[0, 0, 1, 0]));
    let rle: Vec<u8> =
        [4_u32, 64, 0xffff_fff0, 0x7fff_ffff].iter().flat_map(|n| n.to_le_bytes()).chain([0; 96]).collect();
    // Three whole slices, so that it is the decoder that refuses.
    let slices = ["0\\0\\0 ", "0\\0\\1 ", "0\\0\\2 "].map(|position| {
        let mut slice = image("MONOCHROME2 ", size(0x0028_0010, 8), size(0x0028_0011, 8), fragment(&rle));
        slice.insert(1, element(0x0020_0032, "DS", position.as_bytes()));
        slice.insert(2, element(0x0020_0037, "DS", b"1\\0\\0\\0\\1\\0 "));
        dicom(RLE, &slice)
    });
    let philips = vec![
        element(0x0008_0016, "UI", b"1.2.840.10008.5.1.4.1.1.2\0"),
        element(0x07a1_0010, "LO", b"ELSCINT1"),
        element(0x07a1_1011, "LO", b"PMSCT_RLE1"),
        element(0x07a1_100a, "OB", &[0xa5; 64]),
    ];
    let pam = b"P7\nWIDTH 65537\nHEIGHT 65537\nDEPTH 4\nMAXVAL 255\nTUPLTYPE RGB_ALPHA\nENDHDR\nxxxx";
    let inside = image("MONOCHROME2 ", size(0x0028_0010, 0xffff), size(0x0028_0011, 0xffff), fragment(pam));
    let (bomb, request_bomb) = (gzip_of_zeros(1024), gzip_of_zeros(256));
    let length = |value: &'static str| {
        move |server: &Server| {
            let head = format!(
                "POST /v1/jobs HTTP/1.1\r\nhost: {}\r\ncontent-type: multipart/form-data; boundary=B\r\ncontent-length: {value}\r\nconnection: close\r\n\r\n",
                server.address
            );
            server.raw(head.as_bytes(), b"")
        }
    };
    vec![
        file(
            "5437 a meta header that leads out of the file",
            (422, &["input.truncated", "input.malformed"]),
            "a.dcm",
            meta,
        ),
        attack("5438 a gzip bomb as Content-Encoding", (415, &["content_encoding"]), move |server| {
            server.post(
                "/v1/jobs",
                "content-type: multipart/form-data; boundary=B\r\ncontent-encoding: gzip\r\n",
                &request_bomb,
            )
        }),
        file("5438 a gzip bomb as a volume", (413, &["input.too_large"]), "a.nii.gz", bomb),
        file("5439 a zip that tells 4 GiB", (413, &["input.too_large"]), "a.zip", lying(u32::MAX - 1)),
        file("5439 a zip that tells 10 bytes", (422, &["input.malformed", "archive.refused"]), "a.zip", lying(10)),
        attack("5440 a Content-Length of 4 GiB", (413, &["upload.too_large"]), length("4294967296")),
        attack("5440 a Content-Length beyond 2^64", (400, &[""]), length("99999999999999999999")),
        file("5441 Philips' own compression", (422, &["input.no_images"]), "a.dcm", dicom(EXPLICIT, &philips)),
        attack(
            "5441 RLE segments beyond their fragment",
            (200, &["input.malformed", "input.truncated"]),
            move |server| server.upload(&[("a.dcm", &slices[0]), ("b.dcm", &slices[1]), ("c.dcm", &slices[2])]),
        ),
        file(
            "5442 sizes as UL that overflow",
            (422, &["input.malformed", "input.unsupported"]),
            "a.dcm",
            dicom(EXPLICIT, &dimensions),
        ),
        file(
            "5443 a palette image of 2^32 pixels",
            (422, &["input.colour", "input.unsupported"]),
            "a.dcm",
            dicom(EXPLICIT, &overflow),
        ),
        file(
            "5444 PAM whose size overflows 32 bits",
            (422, &["input.no_images", "input.unsupported", "input.malformed"]),
            "a.pam",
            pam.to_vec(),
        ),
        file("5444 PAM inside DICOM", (413, &["input.too_large"]), "a.dcm", dicom("1.2.840.10008.1.2.4.50", &inside)),
        file(
            "5445 palette indices beyond the table",
            (422, &["input.colour", "input.unsupported"]),
            "a.dcm",
            dicom(EXPLICIT, &palette),
        ),
    ]
}

/// Archives, headers and texts.
fn others() -> Vec<Attack> {
    let deep = |open: &str, n: usize| open.repeat(n).into_bytes();
    let wide = format!("{{\"roles\": [{}0]}}", "[0],".repeat(120_000)).into_bytes();
    let keys = format!("{{{}\"z\":0}}", (0..40_000).map(|i| format!("\"k{i}\":0,")).collect::<String>()).into_bytes();
    let nested = zipped(&[("inner.zip", &zipped(&[("a.dcm", b"x")]))]);
    let archive: &[&str] = &["archive.refused"];
    vec![
        file("zip slip", (422, archive), "a.zip", zipped(&[("../../etc/cron.d/x", b"x")])),
        file("an absolute name in a zip", (422, archive), "a.zip", zipped(&[("/etc/cron.d/x", b"x")])),
        file("a link in a zip", (422, archive), "a.zip", link()),
        file("a zip in a zip", (422, archive), "a.zip", nested),
        file("a NUL in a zip's name", (422, archive), "a.zip", zipped(&[("a\0.dcm", b"x")])),
        file("10^6 entries", (413, &["input.too_large"]), "a.zip", crowded(1_000_000, u16::MAX)),
        file("10^6 entries told as 5", (413, &["input.too_large"]), "a.zip", crowded(1_000_000, 5)),
        attack("a NUL in a file's name", (400, &["upload.broken"]), |server| server.upload(&[("a\0.dcm", b"nothing")])),
        attack("a NUL in a path", (404, &["not_found"]), |server| server.post("/v1/jobs/%00/cancel", "", b"")),
        attack("a header of 1 MiB", (431, &[""]), |server| {
            let head = format!("GET /v1/jobs HTTP/1.1\r\nhost: {}\r\nx-a: {}", server.address, "a".repeat(1 << 20));
            server.raw(head.as_bytes(), b"\r\n\r\n")
        }),
        attack("10^5 headers", (431, &[""]), |server| {
            let head = format!("GET /v1/jobs HTTP/1.1\r\nhost: {}\r\n{}", server.address, "a: b\r\n".repeat(5_000));
            server.raw(head.as_bytes(), b"\r\n")
        }),
        attack("a plan 10^5 deep", (413, &["plan.too_large"]), move |server| server.plan(&deep("[", 100_000))),
        attack("a plan of objects 10^5 deep", (413, &["plan.too_large"]), move |server| {
            server.plan(&"{\"a\":".repeat(100_000).into_bytes())
        }),
        attack(
            "a plan of 10^5 lists",
            (422, &["plan.invalid", "plan.not_json", "plan.unknown_field"]),
            move |server| server.plan(&wide),
        ),
        attack("a plan of 4 * 10^4 fields", (422, &["plan.unknown_field"]), move |server| server.plan(&keys)),
        attack("a plan of 2 MiB", (413, &["plan.too_large"]), |server| server.plan(&vec![b' '; 2 << 20])),
        attack("a deep body of another call", (422, &["bad_request"]), move |server| {
            server.post("/v1/webhooks", "content-type: application/json\r\n", &"[".repeat(60_000).into_bytes())
        }),
        attack("10^4 parts", (413, &["upload.parts"]), |server| {
            let files: Vec<(&str, &[u8])> = vec![("a", b"x"); 10_000];
            server.upload(&files)
        }),
    ]
}

/// Asks for something small all the time; the longest wait in ms.
fn bystander(address: String, stop: Arc<AtomicBool>) -> std::thread::JoinHandle<u64> {
    std::thread::spawn(move || {
        let mut longest = 0;
        while !stop.load(Ordering::Relaxed) {
            let begun = Instant::now();
            let mut stream = TcpStream::connect(&address).unwrap();
            stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
            write!(stream, "GET /v1/jobs HTTP/1.1\r\nhost: {address}\r\nconnection: close\r\n\r\n").unwrap();
            let (status, _) = answer(&mut stream);
            assert_eq!(status, 200, "somebody else was not answered");
            longest = longest.max(begun.elapsed().as_millis() as u64);
            std::thread::sleep(Duration::from_millis(20));
        }
        longest
    })
}

#[test]
fn hostile_uploads_are_refused_by_name_within_time_and_memory() {
    let server = Server::start();
    // The first upload pays for the pools of threads and buffers.
    server.upload(&[("warm.dcm", &vec![7; 1 << 20])]);
    let stop = Arc::new(AtomicBool::new(false));
    let other = bystander(server.address.clone(), Arc::clone(&stop));
    let mut faults = Vec::new();
    for attack in advisories().into_iter().chain(others()) {
        fs::write(format!("/proc/{}/clear_refs", server.process.id()), "5").unwrap();
        let before = server.memory("VmRSS:");
        let begun = Instant::now();
        let (status, code) = (attack.send)(&server);
        let took = begun.elapsed();
        let grown = server.memory("VmHWM:").saturating_sub(before);
        let line = format!("{}: {status} {code} in {took:?}, +{grown} MiB", attack.name);
        println!("{line}");
        let refused = status == attack.status && attack.codes.contains(&code.as_str());
        if !refused || took > REFUSED_WITHIN || grown > MEMORY_MIB + attack.own_mib {
            faults.push(line);
        }
    }
    stop.store(true, Ordering::Relaxed);
    let longest = other.join().unwrap();
    assert!(faults.is_empty(), "{faults:#?}");
    assert!(u128::from(longest) <= ANSWERED_WITHIN.as_millis(), "somebody else waited {longest} ms");
}

#[test]
fn slow_clients_are_cut_off_and_hold_nobody_up() {
    let server = Server::start();
    let open = AtomicU64::new(0);
    let begun = Instant::now();
    let mut slow: Vec<TcpStream> = (0..300)
        .map(|_| {
            let mut stream = TcpStream::connect(&server.address).unwrap();
            stream.set_read_timeout(Some(Duration::from_millis(1))).unwrap();
            stream.write_all(b"GET /v1/jobs HTTP/1.1\r\nhost: a\r\n").unwrap();
            open.fetch_add(1, Ordering::Relaxed);
            stream
        })
        .collect();
    let mut longest = Duration::ZERO;
    while !slow.is_empty() {
        assert!(begun.elapsed() < Duration::from_secs(15), "{} slow clients are still there", slow.len());
        slow.retain_mut(|stream| {
            let _ = stream.write_all(b"x");
            // Closed: nothing, or a reset. Open: the read times out.
            matches!(stream.read(&mut [0; 64]), Err(e) if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut))
        });
        let asked = Instant::now();
        assert_eq!(server.post("/v1/jobs/cancel", "", b"").0, 200);
        longest = longest.max(asked.elapsed());
    }
    assert!(begun.elapsed() >= Duration::from_secs(5), "an honest client on a bad line needs some time");
    assert!(longest < ANSWERED_WITHIN, "somebody else waited {longest:?}");
}
