//! Changes valid files and reads them again, for as long as is asked: no reader may panic, hang or allocate by a lie.
//!
//!     fuzz READER SECONDS SEED FOLDER [CORPUS...]
//!
//! `cargo xtask fuzz` runs it under a limit on the address space. The case at hand lies in FOLDER/READER.case, so that
//! whatever ends the process leaves its cause behind.

use artefact::plan::Plan;
use artefact::read::{Limits, NamedBytes, intake, stack_of};
use artefact::write::{self, dicom::Meta, dicom::Numbering};
use imaging::Stack;
use space::{P3, V3};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

/// A case of this size that takes longer hangs.
const SLOWEST: Duration = Duration::from_secs(2);
/// Largest file of a corpus that is used.
const LARGEST: u64 = 300_000;

fn main() -> ExitCode {
    match run(&std::env::args().skip(1).collect::<Vec<_>>()) {
        Ok(line) => {
            println!("{line}");
            ExitCode::SUCCESS
        }
        Err(e) => {
            eprintln!("fuzz: {e}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &[String]) -> Result<String, String> {
    let [reader, seconds, seed, folder, corpus @ ..] = arguments else {
        return Err("usage: fuzz READER SECONDS SEED FOLDER [CORPUS...]".to_owned());
    };
    let seconds: u64 = seconds.parse().map_err(|e| format!("{seconds}: {e}"))?;
    let mut random = Random(seed.parse::<u64>().map_err(|e| format!("{seed}: {e}"))? | 1);
    let mut seeds = seeds(reader)?;
    for folder in corpus {
        seeds.extend(files(Path::new(folder)).map_err(|e| format!("{folder}: {e}"))?);
    }
    let case_file = PathBuf::from(folder).join(format!("{reader}.case"));
    // decoders of others may panic, which the reader catches and answers: their messages are noise
    std::panic::set_hook(Box::new(|_| {}));
    let started = Instant::now();
    let (mut cases, mut read, mut slowest) = (0u64, 0u64, Duration::ZERO);
    while started.elapsed() < Duration::from_secs(seconds) {
        let mut file = seeds[random.below(seeds.len())].clone();
        let other = seeds[random.below(seeds.len())].bytes.clone();
        for _ in 0..=random.below(4) {
            change(&mut file.bytes, &other, &mut random);
        }
        std::fs::write(&case_file, &file.bytes).map_err(|e| format!("{}: {e}", case_file.display()))?;
        let begun = Instant::now();
        read += u64::from(try_out(file)?);
        slowest = slowest.max(begun.elapsed());
        if begun.elapsed() > SLOWEST {
            return Err(format!("{reader}: case {cases} took {:.1} s: {}", slowest.as_secs_f64(), case_file.display()));
        }
        cases += 1;
    }
    let _ = std::fs::remove_file(&case_file);
    Ok(format!("{reader}: {cases} cases, {read} of them read, slowest {:.3} s", slowest.as_secs_f64()))
}

/// Read through both doors; whether a stack came out.
fn try_out(file: NamedBytes) -> Result<bool, String> {
    let limits = Limits { total_bytes: 8 << 20, pixels: 1 << 20, ..Limits::default() };
    let outcome = std::panic::catch_unwind(|| {
        let plan = Plan::parse(br#"{"geometry": {"pixel_spacing_mm": [1, 1], "slice_spacing_mm": 1}}"#)?;
        let clean = intake(vec![file.clone()], &limits).is_ok();
        let alone = stack_of(vec![file.clone()], &plan, &limits).is_ok();
        // twice the file: one slice alone is never a stack
        let twice = vec![file.clone(), NamedBytes { name: format!("2{}", file.name), ..file }];
        Ok::<_, artefact::plan::PlanFaults>(stack_of(twice, &plan, &limits).is_ok() || alone || clean)
    });
    match outcome {
        Ok(Ok(read)) => Ok(read),
        Ok(Err(e)) => Err(e.to_string()),
        Err(_) => Err("a reader panicked; the case is kept".to_owned()),
    }
}

fn change(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    const NUMBERS: [u64; 8] = [0, 1, 0x7f, 0xff, 0x7fff, 0xffff, 0x7fff_ffff, 0xffff_ffff];
    if bytes.is_empty() {
        bytes.extend(other.iter().take(64));
        return;
    }
    // headers lie at the front: half of the changes fall there
    let reach = if random.below(2) == 0 { bytes.len().min(1500) } else { bytes.len() };
    let at = random.below(reach);
    let length = 1 + random.below(64.min(bytes.len() - at));
    match random.below(8) {
        0 => bytes[at] ^= 1 << random.below(8),
        1 => bytes[at] = random.below(256) as u8,
        2 => bytes.truncate(at),
        3 => drop(bytes.drain(at..at + length)),
        4 => {
            let copy = bytes[at..at + length].to_vec();
            bytes.splice(at..at, copy);
        }
        5 => {
            let number = NUMBERS[random.below(8)].to_le_bytes();
            let width = 1 << random.below(4);
            bytes.iter_mut().skip(at).zip(&number[..width]).for_each(|(b, n)| *b = *n);
        }
        6 => {
            let from = random.below(other.len().max(1)).min(other.len());
            let piece = &other[from..(from + length).min(other.len())];
            bytes.splice(at..at + length, piece.iter().copied());
        }
        _ => bytes.splice(at..at, (0..length).map(|_| random.below(256) as u8)).for_each(drop),
    }
    bytes.truncate(2 * LARGEST as usize);
}

/// A valid file or more of each reader's kind.
fn seeds(reader: &str) -> Result<Vec<NamedBytes>, String> {
    let stack = stack();
    let one = |name: &str, bytes: Vec<u8>| NamedBytes::new(name, bytes);
    let pictures = || write::png::slices(&stack).map_err(words);
    Ok(match reader {
        "dicom" => {
            let meta = Meta { seed: 1, description: String::new(), numbering: Numbering::Ascending };
            let files = write::dicom::slices(&stack, &meta).map_err(words)?;
            files.into_iter().map(|f| one(&f.name, f.bytes)).collect()
        }
        "nifti" => vec![one("a.nii", write::nifti::volume(&stack).map_err(words)?)],
        "metaimage" => vec![one("a.mha", write::metaimage::volume(&stack).map_err(words)?)],
        "nrrd" => {
            let header = "NRRD0004\ntype: short\ndimension: 3\nspace: LPS\nsizes: 2 2 2\nspace directions: (1,0,0) \
                          (0,1,0) (0,0,1)\nendian: little\nencoding: raw\nspace origin: (0,0,0)\n\n0123456789abcdef";
            vec![one("a.nrrd", header.into())]
        }
        "pictures" => {
            let mut float = std::io::Cursor::new(Vec::new());
            let mut tiff = tiff::encoder::TiffEncoder::new(&mut float).map_err(words)?;
            tiff.write_image::<tiff::encoder::colortype::Gray32Float>(4, 3, &[0.5; 12]).map_err(words)?;
            let pgm = [&b"P5 4 3 255\n"[..], &[7; 12]].concat();
            let mut all: Vec<NamedBytes> = pictures()?.into_iter().map(|f| one(&f.name, f.bytes)).collect();
            all.retain(|f| f.name.ends_with(".png"));
            all.extend([one("a.tif", float.into_inner()), one("a.pgm", pgm)]);
            all
        }
        "archive" => {
            let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
            for f in pictures()? {
                zip.start_file(f.name.as_str(), zip::write::SimpleFileOptions::default()).map_err(words)?;
                std::io::Write::write_all(&mut zip, &f.bytes).map_err(words)?;
            }
            vec![one("a.zip", zip.finish().map_err(words)?.into_inner())]
        }
        other => return Err(format!("no reader is called {other}")),
    })
}

fn words(e: impl std::fmt::Display) -> String {
    e.to_string()
}

/// A small oblique stack with texture.
fn stack() -> Stack {
    let (u, v) = (V3::new(0.8, 0.6, 0.0), V3::new(0.0, 0.0, -1.0));
    let normal = u.cross(v);
    Stack {
        columns: 12,
        rows: 9,
        pixels: (0..12 * 9 * 4).map(|i| (i * 37 % 60_000) as f32).collect(),
        pixel_spacing_mm: [0.5, 0.75],
        row_direction: u,
        column_direction: v,
        origins: (0..4).map(|k| P3::new(-20.5, 13.25, 40.0) + normal * (1.5 * f64::from(k))).collect(),
        thickness_mm: Some(2.0),
    }
}

/// The small files of a folder, in name order.
fn files(folder: &Path) -> std::io::Result<Vec<NamedBytes>> {
    let mut paths: Vec<PathBuf> = std::fs::read_dir(folder)?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
    paths.sort();
    let mut out = Vec::new();
    for path in paths.iter().filter(|p| p.is_file()) {
        if std::fs::metadata(path)?.len() <= LARGEST {
            let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
            out.push(NamedBytes::new(name, std::fs::read(path)?));
        }
    }
    Ok(out)
}

/// xorshift64* (Vigna 2016): the same cases for the same seed.
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize % n.max(1)
    }
}
