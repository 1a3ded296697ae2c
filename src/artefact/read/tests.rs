#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
use super::*;
use crate::plan::Plan;
use crate::write::{self, dicom::Meta, dicom::Numbering};
use imaging::Stack;
use proptest::prelude::*;
use space::{Faulty, P3, V3};
use std::io::{Cursor, Write};

const SIZE: [usize; 3] = [7, 5, 6];

/// An oblique stack with values that tell every voxel from every other.
fn oblique() -> Stack {
    let [columns, rows, slices] = SIZE;
    let u = V3::new(0.8, 0.6, 0.0);
    let v = V3::new(0.0, 0.0, -1.0);
    let n = u.cross(v);
    let origin = P3::new(-20.5, 13.25, 40.0);
    Stack {
        columns,
        rows,
        pixels: (0..columns * rows * slices).map(|i| (i * 37 % 60_000) as f32).collect(),
        pixel_spacing_mm: [0.5, 0.75],
        row_direction: u,
        column_direction: v,
        origins: (0..slices).map(|k| origin + n * (1.5 * k as f64)).collect(),
        thickness_mm: Some(2.0),
    }
}

fn scan(numbering: Numbering) -> Vec<NamedBytes> {
    write::dicom::slices(&oblique(), &Meta { seed: 1, description: "test".into(), numbering }).unwrap()
}

fn read(files: Vec<NamedBytes>) -> Result<(Stack, InputReport), Error> {
    stack_of(files, &Plan::default(), &Limits::default())
}

fn assert_same(a: &Stack, b: &Stack, tolerance: f64) {
    assert_eq!((a.columns, a.rows, a.slices()), (b.columns, b.rows, b.slices()));
    assert_eq!(a.pixels, b.pixels);
    for k in 0..a.slices() {
        for (r, c) in [(0, 0), (a.rows - 1, 0), (0, a.columns - 1)] {
            let (p, q) = (a.position(k, r as f64, c as f64), b.position(k, r as f64, c as f64));
            assert!(p.distance(q) <= tolerance, "slice {k}: {p:?} {q:?}");
        }
    }
}

fn code(r: Result<(Stack, InputReport), Error>) -> (&'static str, Option<String>) {
    let e = r.unwrap_err();
    (e.code(), e.place().file)
}

fn zipped(files: &[NamedBytes]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for f in files {
        zip.start_file(f.name.as_str(), zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(&f.bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

fn gzipped(bytes: &[u8]) -> Vec<u8> {
    let mut gz = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    gz.write_all(bytes).unwrap();
    gz.finish().unwrap()
}

#[test]
fn every_format_gives_the_stack_that_was_written() {
    let truth = oblique();
    let (s, report) = read(scan(Numbering::Ascending)).unwrap();
    assert_same(&s, &truth, 1e-9);
    assert_eq!(report.spacing_mm[..2], [0.5, 0.75]);
    assert!((report.spacing_mm[2] - 1.5).abs() < 1e-9);
    assert_eq!(s.thickness_mm, Some(2.0));
    assert_eq!(report.warnings, []);
    let nii = write::nifti::volume(&truth).unwrap();
    assert_same(&read(vec![NamedBytes::new("a.nii", nii.clone())]).unwrap().0, &truth, 1e-6);
    assert_same(&read(vec![NamedBytes::new("a.nii.gz", gzipped(&nii))]).unwrap().0, &truth, 1e-6);
    let mha = write::metaimage::volume(&truth).unwrap();
    assert_same(&read(vec![NamedBytes::new("a.mha", mha)]).unwrap().0, &truth, 1e-9);
    assert_same(&read(write::png::slices(&truth).unwrap()).unwrap().0, &truth, 1e-9);
    let zip = NamedBytes::new("a.zip", zipped(&write::png::slices(&truth).unwrap()));
    assert_same(&read(vec![zip]).unwrap().0, &truth, 1e-9);
}

#[test]
fn file_order_names_and_instance_numbers_change_nothing() {
    let straight = read(scan(Numbering::Ascending)).unwrap().1.digest;
    for numbering in [Numbering::Descending, Numbering::Interleaved] {
        let mut files = scan(numbering);
        files.reverse();
        files.swap(1, 4);
        for (i, f) in files.iter_mut().enumerate() {
            f.name = format!("x{}", (i * 5) % 7);
        }
        assert_eq!(read(files).unwrap().1.digest, straight);
    }
}

#[test]
fn intake_keeps_the_stack_and_drops_the_patient() {
    let canary = b"SMITH^CANARY";
    let mut files = scan(Numbering::Ascending);
    for f in &mut files {
        // a private element with a name in it, before the pixels
        let at = f.bytes.windows(4).position(|w| w == [0x10, 0, 0x10, 0]).unwrap();
        let mut private = vec![0x09, 0, 0x10, 0, b'L', b'O', canary.len() as u8, 0];
        private.extend(canary);
        f.bytes.splice(at..at, private);
        f.name = format!("smith/{}", f.name);
    }
    let truth = read(files.clone()).unwrap().1;
    let clean = intake(vec![NamedBytes::new("smith.zip", zipped(&files))], &Limits::default()).unwrap();
    assert_eq!(clean[0].name, "image-00001.dcm");
    for f in &clean {
        for word in [&b"SMITH"[..], b"Anonymous", b"smith"] {
            assert!(!f.bytes.windows(word.len()).any(|w| w == word));
        }
    }
    let again = read(clean).unwrap().1;
    assert_eq!((again.digest, again.acquisition), (truth.digest, truth.acquisition));
    let volumes = [
        NamedBytes::new("a.nii", write::nifti::volume(&oblique()).unwrap()),
        NamedBytes::new("a.mha", write::metaimage::volume(&oblique()).unwrap()),
    ];
    for file in volumes {
        let before = read(vec![file.clone()]).unwrap().1.digest;
        let after = read(intake(vec![file], &Limits::default()).unwrap()).unwrap().1.digest;
        assert_eq!(before, after);
    }
    let pictures = write::png::slices(&oblique()).unwrap();
    let before = read(pictures.clone()).unwrap().1.digest;
    assert_eq!(read(intake(pictures, &Limits::default()).unwrap()).unwrap().1.digest, before);
}

#[test]
fn a_missing_slice_is_a_gap_and_the_others_stay() {
    let mut files = scan(Numbering::Ascending);
    files.remove(2);
    let (s, report) = read(files).unwrap();
    assert_eq!(report.missing_slices, [2]);
    assert_eq!(report.warnings[0].code, "stack.gap");
    assert!((s.offset_mm(4) - 7.5).abs() < 1e-9, "{}", s.offset_mm(4));
}

#[test]
fn a_volume_stored_against_its_normal_is_turned_around() {
    let s = oblique();
    let mut mha = String::from_utf8_lossy(&write::metaimage::volume(&s).unwrap()).into_owned();
    mha.truncate(mha.find("LOCAL\n").unwrap() + 6);
    let n = s.normal();
    let last = s.origins[5].to_array().map(|x| x.to_string()).join(" ");
    let first = s.origins[0].to_array().map(|x| x.to_string()).join(" ");
    let axis = |v: V3| v.to_array().map(|x| format!("{}", x + 0.0)).join(" ");
    mha = mha.replace(&format!(" {}\nOffset = {first}", axis(n)), &format!(" {}\nOffset = {last}", axis(-n)));
    assert!(mha.contains(&last));
    let mut bytes = mha.into_bytes();
    for k in (0..6).rev() {
        bytes.extend(s.slice(k).iter().flat_map(|p| (*p as u16).to_le_bytes()));
    }
    assert_same(&read(vec![NamedBytes::new("a.mha", bytes)]).unwrap().0, &s, 1e-9);
}

#[test]
fn bad_input_is_refused_by_code_and_place() {
    let good = || scan(Numbering::Ascending);
    assert_eq!(code(read(vec![])).0, "input.no_images");
    assert_eq!(code(read(vec![NamedBytes::new("readme.txt", "hello")])).0, "input.no_images");
    assert_eq!(code(read(good()[..1].to_vec())).0, "stack.too_few_slices");
    let mut files = good();
    let half = files[3].bytes.len() - 20;
    files[3].bytes.truncate(half);
    assert_eq!(code(read(files)), ("input.truncated", Some("slice-0003.dcm".into())));
    let mut files = good();
    files.push(NamedBytes::new("again.dcm", files[2].bytes.clone()));
    assert_eq!(code(read(files)).0, "stack.duplicate_position");
    let mut small = oblique();
    small.rows = 4;
    small.pixels.truncate(7 * 4 * 6);
    let odd =
        write::dicom::slices(&small, &Meta { seed: 1, description: String::new(), numbering: Numbering::Ascending });
    let mut files = good();
    files[5].bytes = odd.unwrap()[5].bytes.clone();
    assert_eq!(code(read(files)), ("input.unequal_sizes", Some("slice-0005.dcm".into())));
    let mut files = good();
    files.push(NamedBytes::new("a.nii", write::nifti::volume(&oblique()).unwrap()));
    assert_eq!(code(read(files)).0, "input.mixed");
    let mut files = write::png::slices(&oblique()).unwrap();
    files.pop();
    let e = read(files).unwrap_err();
    assert_eq!(e.code(), "input.geometry_missing");
    assert_eq!(e.place().field.as_deref(), Some("geometry.pixel_spacing_mm"));
    let mut files = good();
    files.push(NamedBytes::new("x.bin", vec![1; 300]));
    assert_eq!(code(read(files)), ("input.unsupported", Some("x.bin".into())));
}

#[test]
fn a_tilted_gantry_is_refused() {
    let mut s = oblique();
    for (k, o) in s.origins.iter_mut().enumerate() {
        *o += s.column_direction * (0.3 * k as f64);
    }
    let files =
        write::dicom::slices(&s, &Meta { seed: 1, description: String::new(), numbering: Numbering::Ascending });
    let e = read(files.unwrap()).unwrap_err();
    assert!(
        matches!(e, Error::GantryTilt { degrees } if (degrees - 0.3f64.atan2(1.5).to_degrees()).abs() < 1e-6),
        "{e}"
    );
}

#[test]
fn huge_headers_are_refused_before_anything_is_allocated() {
    let mut nii = write::nifti::volume(&oblique()).unwrap();
    nii[42..44].copy_from_slice(&i16::MAX.to_le_bytes());
    assert_eq!(code(read(vec![NamedBytes::new("a.nii", nii)])).0, "input.too_large");
    let mha = b"NDims = 3\nDimSize = 70000 70000 30\nElementSpacing = 1 1 1\nElementType = MET_SHORT\nElementDataFile = LOCAL\n";
    assert_eq!(code(read(vec![NamedBytes::new("a.mha", mha.to_vec())])).0, "input.too_large");
    let mut files = scan(Numbering::Ascending);
    let at = files[0].bytes.windows(6).position(|w| w == [0x28, 0, 0x10, 0, b'U', b'S']).unwrap();
    files[0].bytes[at + 8..at + 10].copy_from_slice(&60_000u16.to_le_bytes());
    assert_eq!(code(read(files)).0, "input.too_large");
    let mut png = write::png::slices(&oblique()).unwrap().remove(0).bytes;
    png[16..20].copy_from_slice(&70_000u32.to_be_bytes());
    png[20..24].copy_from_slice(&70_000u32.to_be_bytes());
    // the header's checksum, so that the size is what is refused
    let mut crc = flate2::Crc::new();
    crc.update(&png[12..29]);
    png[29..33].copy_from_slice(&crc.sum().to_be_bytes());
    let plan = Plan::parse(br#"{"geometry": {"pixel_spacing_mm": [1, 1], "slice_spacing_mm": 1}}"#).unwrap();
    let r = stack_of(vec![NamedBytes::new("a.png", png)], &plan, &Limits::default());
    assert_eq!(code(r).0, "input.too_large");
}

#[test]
fn hostile_archives_are_refused() {
    let file = |name: &str, bytes: Vec<u8>| NamedBytes::new(name, bytes);
    let slip = zipped(&[file("../../etc/x.dcm", vec![0; 10])]);
    assert_eq!(code(read(vec![file("a.zip", slip)])).0, "archive.refused");
    let nested = zipped(&[file("b.zip", zipped(&[file("x", vec![1])]))]);
    assert_eq!(code(read(vec![file("a.zip", nested)])).0, "archive.refused");
    let bomb = zipped(&[file("x", vec![0; 64 << 20])]);
    assert_eq!(code(read(vec![file("a.zip", bomb)])).0, "input.too_large");
    let gz = gzipped(&vec![0; 64 << 20]);
    assert_eq!(code(read(vec![file("a.nii.gz", gz)])).0, "input.too_large");
    let many: Vec<NamedBytes> = (0..20).map(|i| file(&format!("{i}"), vec![1])).collect();
    let limits = Limits { entries: 10, ..Limits::default() };
    assert_eq!(code(stack_of(vec![file("a.zip", zipped(&many))], &Plan::default(), &limits)).0, "input.too_large");
}

#[test]
fn colour_is_refused_and_names_sort_by_their_numbers() {
    let mut png = Vec::new();
    let rgb: Vec<u8> = (0..27).collect();
    let encoder = image::codecs::png::PngEncoder::new(&mut png);
    image::ImageEncoder::write_image(encoder, &rgb, 3, 3, image::ExtendedColorType::Rgb8).unwrap();
    let plan = Plan::parse(br#"{"geometry": {"pixel_spacing_mm": [1, 1], "slice_spacing_mm": 1}}"#).unwrap();
    assert_eq!(code(stack_of(vec![NamedBytes::new("a.png", png)], &plan, &Limits::default())).0, "input.colour");
    let mut names = ["s10.png", "s2.png", "s1.png", "s02.png"];
    names.sort_by(|a, b| pictures::natural(a, b));
    assert_eq!(names, ["s1.png", "s02.png", "s2.png", "s10.png"]);
}

/// The real scan lies beside the project where it is there at all.
#[test]
fn the_real_scan_is_read() {
    let path = std::path::PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/aorta.mha"));
    let path = std::env::var_os("VASCULUM_DATA").map_or(path, |d| std::path::PathBuf::from(d).join("aorta.mha"));
    if !path.exists() {
        eprintln!("skipped: no data");
        return;
    }
    let (s, report) = stack(&[path], &Plan::default(), &Limits::default()).unwrap();
    assert_eq!((s.columns, s.rows, s.slices()), (157, 393, 34));
    assert_eq!(report.spacing_mm[..2], [0.878906, 0.878906]);
    assert!((report.spacing_mm[2] - 1.50009).abs() < 1e-9);
    // TransformMatrix -1 0 0 / 0 -1 0 / 0 0 1, Offset -156.445 -24.6094 0
    assert_eq!(s.position(0, 0.0, 0.0).to_array(), [-156.445, -24.6094, 0.0]);
    assert_eq!(s.row_direction, -V3::X);
}

/// Small changes of valid files reach deep into the parsers; none may panic or allocate by a lie.
fn mangled(file: &NamedBytes, changes: &[(usize, u8)]) -> NamedBytes {
    let mut bytes = file.bytes.clone();
    let n = bytes.len().min(1200);
    for (at, b) in changes {
        bytes[at % n] = *b;
    }
    NamedBytes::new(file.name.clone(), bytes)
}

fn survives(file: NamedBytes) {
    let limits = Limits { total_bytes: 8 << 20, pixels: 1 << 20, ..Limits::default() };
    let plan = Plan::parse(br#"{"geometry": {"pixel_spacing_mm": [1, 1], "slice_spacing_mm": 1}}"#).unwrap();
    let _ = stack_of(vec![file.clone()], &plan, &limits);
    let _ = intake(vec![file], &limits);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn no_change_of_a_valid_file_brings_a_reader_down(changes in prop::collection::vec((any::<usize>(), any::<u8>()), 1..6)) {
        let s = oblique();
        let nrrd = b"NRRD0004\ntype: short\ndimension: 3\nspace: LPS\nsizes: 2 2 2\nspace directions: (1,0,0) (0,1,0) (0,0,1)\nendian: little\nencoding: raw\nspace origin: (0,0,0)\n\n0123456789abcdef";
        let pictures = write::png::slices(&s).unwrap();
        let (_, tif) = write::png::lossless(&[0.5; 12], 4, 3).unwrap();
        for file in [
            scan(Numbering::Ascending).remove(0),
            NamedBytes::new("a.nii", write::nifti::volume(&s).unwrap()),
            NamedBytes::new("a.mha", write::metaimage::volume(&s).unwrap()),
            NamedBytes::new("a.nrrd", nrrd.to_vec()),
            NamedBytes::new("a.tif", tif),
            pictures[0].clone(),
            NamedBytes::new("a.zip", zipped(&pictures[..2])),
        ] {
            survives(mangled(&file, &changes));
        }
    }
    #[test]
    fn no_bytes_bring_a_reader_down(magic in 0usize..6, bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let magics: [&[u8]; 6] = [b"", b"\x08\0\x05\0CS\x04\0", b"PK\x03\x04", b"NRRD0004\n", b"II\x2a\0", b"P5 "];
        let mut all = magics[magic].to_vec();
        all.extend(bytes);
        survives(NamedBytes::new("x", all));
    }
}
