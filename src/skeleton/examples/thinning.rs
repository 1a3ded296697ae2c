//! Time and memory of thinning one volume, for `cargo xtask bench thinning`, which runs other programs on the same file.
//!
//! `thinning make N FILE` writes a bifurcation of three tubes of radius N / 18 in a cube of N^3 voxels, one byte each,
//! x fastest. `thinning run N FILE THREADS` thins it and prints one line: seconds, CPU seconds, voxels before and after,
//! the growth of the process's peak memory in bytes.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod bifurcation;

use bifurcation::bifurcation;
use exec::Ctx;
use skeleton::{BitVolume, thin};
use std::time::Instant;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let n: usize = arguments[1].parse().expect("a number of voxels");
    match arguments[0].as_str() {
        "make" => std::fs::write(&arguments[2], bytes(&bifurcation(n))).expect("the file can be written"),
        "run" => run(n, &arguments[2], arguments[3].parse().expect("a number of threads")),
        other => panic!("make or run, not {other}"),
    }
}

fn run(n: usize, file: &str, threads: usize) {
    let mut volume = BitVolume::new([n, n, n]);
    let bytes = std::fs::read(file).expect("the file can be read");
    for i in (0..bytes.len()).filter(|&i| bytes[i] != 0) {
        volume.set([i % n, i / n % n, i / n / n]);
    }
    drop(bytes);
    let ctx = Ctx::new(threads).expect("threads");
    let before = volume.count();
    // the input file was larger than what thinning takes: only the peak from here on counts
    std::fs::write("/proc/self/clear_refs", "5").expect("Linux");
    let (resident, cpu, start) = (status("VmRSS"), cpu_seconds(), Instant::now());
    let report = thin(&mut volume, &ctx).expect("thinned");
    let (wall, cpu) = (start.elapsed().as_secs_f64(), cpu_seconds() - cpu);
    let grown = status("VmHWM").saturating_sub(resident);
    println!("{wall:.6} {cpu:.6} {before} {} {grown}", report.remaining);
}

/// A field of /proc/self/status, bytes.
fn status(name: &str) -> u64 {
    let text = std::fs::read_to_string("/proc/self/status").expect("Linux");
    let line = text.lines().find(|l| l.starts_with(name)).expect("the field");
    1024 * line.split_whitespace().nth(1).and_then(|kb| kb.parse::<u64>().ok()).expect("kilobytes")
}

/// Time on a processor of all threads, seconds (the kernel counts nanoseconds per thread).
fn cpu_seconds() -> f64 {
    let tasks = std::fs::read_dir("/proc/self/task").expect("Linux");
    let spent = |t: std::fs::DirEntry| std::fs::read_to_string(t.path().join("schedstat")).expect("Linux");
    let nanoseconds = |text: String| text.split_whitespace().next().and_then(|t| t.parse::<f64>().ok());
    tasks.map(|t| nanoseconds(spent(t.expect("a thread"))).expect("nanoseconds")).sum::<f64>() / 1e9
}

fn bytes(volume: &BitVolume) -> Vec<u8> {
    let [nx, ny, nz] = volume.size();
    let mut out = vec![0; nx * ny * nz];
    for [i, j, k] in volume.voxels() {
        out[(k * ny + j) * nx + i] = 255;
    }
    out
}
