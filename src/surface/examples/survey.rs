//! The surface over many random phantoms and lattice shifts: shapes, evaluations and times.
//!
//! `cargo run --release -p surface --example survey -- [COUNT] [FIRST] [FOLDER]`; one line per mesh, the worst of all at the
//! end; with a folder, every mesh as OFF for other judges.
//! Ends with a fault when a bar of the surface is missed.
#![allow(missing_docs, clippy::unwrap_used)]

#[allow(dead_code)]
#[path = "../fields.rs"]
mod fields;
#[allow(dead_code)]
#[path = "../phantoms.rs"]
mod phantoms;

use exec::Ctx;
use phantoms::{Dice, Phantom, phantom};
use std::time::Instant;
use surface::*;

struct Line {
    name: String,
    quality: Quality,
    report: RemeshReport,
    cells_per: f64,
    sound: bool,
    least: f64,
    halvings: i32,
    ms: f64,
    /// Wall and CPU time of remeshing alone, s, of the benchmark.
    alone: Option<[f64; 2]>,
    mesh: TriMesh,
    /// The wall of adaptive meshes as quadrilaterals, and the time it took, ms.
    quads: Option<(Result<Quads, Error>, f64)>,
    /// Whether every vessel reaches a cap, so that there must be quadrilaterals.
    open: bool,
}

fn run(name: &str, p: &Phantom, shift: [f64; 3], sizing: Sizing, max_error_mm: f64, ctx: &Ctx) -> Result<Line, Error> {
    let cell = PolygoniseSettings { shift, ..PolygoniseSettings::default() };
    let settings = RemeshSettings { sizing, max_error_mm, ..RemeshSettings::default() };
    let mut alone = None;
    if let (true, Some(folder)) = (name.starts_with("benchmark"), std::env::args().nth(3)) {
        // In a folder of its own: what remeshers start from is not a surface to be judged.
        std::fs::create_dir_all(format!("{folder}/raw")).unwrap();
        let (raw, _) = polygonise(&p.field, &[p.seed], &cell, ctx)?;
        std::fs::write(format!("{folder}/raw/benchmark.off"), off(&raw)).unwrap();
        let (t, cpu) = (Instant::now(), cpu_s());
        remesh(&raw, &p.field, &p.cuts, &settings, ctx)?;
        alone = Some([t.elapsed().as_secs_f64(), cpu_s() - cpu]);
    }
    let t = Instant::now();
    let found = shell(&p.field, &[p.seed], &p.cuts, &cell, &settings, ctx)?;
    let ms = t.elapsed().as_secs_f64() * 1e3;
    let Shell { mesh, remeshed: report, polygonised, halvings, .. } = found;
    let topology = check(&mesh).unwrap();
    let sound =
        topology.euler == p.euler && topology.components == 1 && self_intersections(&mesh, ctx).unwrap().is_empty();
    let least = if matches!(sizing, Sizing::Curvature) { 30.0 } else { 33.0 };
    let cells_per = polygonised.cells_visited as f64 / polygonised.cells as f64;
    let quality = quality(&mesh, &p.field, ctx).unwrap();
    let quads = matches!(sizing, Sizing::Curvature).then(|| {
        let t = Instant::now();
        let quads = quads(&mesh, &p.field, &p.cuts, &p.sections, &QuadSettings::default(), ctx);
        (quads, t.elapsed().as_secs_f64() * 1e3)
    });
    let caps = mesh.face_id.iter().copied().max().unwrap_or(WALL) as usize;
    let open = !p.sections.is_empty() || (p.branches > 0 && caps == p.branches);
    Ok(Line { name: name.into(), quality, report, cells_per, sound, least, halvings, ms, alone, mesh, quads, open })
}

impl Line {
    fn calls(&self) -> f64 {
        (self.report.evaluations + self.report.hessians) as f64 / self.report.vertices as f64
    }
    fn holds(&self) -> bool {
        let q = &self.quality;
        self.sound
            && q.min_angle_deg >= self.least
            && q.max_angle_deg <= 120.0
            && q.vertex_max_mm <= 1e-9
            && self.calls() <= 6.0
            && self.patched()
    }
    /// Quadrilaterals within .01 mm, proven not to fold, wherever every vessel reaches a cap.
    fn patched(&self) -> bool {
        match &self.quads {
            Some((Ok(q), _)) => q.max_error_mm <= 0.01 && q.least_jacobian > 0.0,
            Some((Err(_), _)) => !self.open,
            None => true,
        }
    }
    fn show(&self) {
        let (q, r) = (&self.quality, &self.report);
        println!(
            "{:<16} {} V {:>6}  angles {:>5.1} {:>6.1}  face max {:.4} rms {:.5} vertex {:.0e}  calls {:.2} ({:.2} hessians) cells {:.3}  halved {}  ms {:.0} {}",
            self.name,
            if self.sound { "sound" } else { "BROKEN" },
            r.vertices,
            q.min_angle_deg,
            q.max_angle_deg,
            q.face_max_mm,
            q.face_rms_mm,
            q.vertex_max_mm,
            self.calls(),
            r.hessians as f64 / r.vertices as f64,
            self.cells_per,
            self.halvings,
            self.ms,
            if self.holds() { "" } else { "MISSED" }
        );
        match &self.quads {
            Some((Ok(q), ms)) => println!(
                "{:<16} {} patches, {} nodes, {:.4} mm, least sine {:.2}, Jacobian {:.3}, {} poles, {ms:.0} ms",
                "",
                q.cells.len(),
                q.nodes.len(),
                q.max_error_mm,
                q.least_sine,
                q.least_jacobian,
                q.poles.len(),
            ),
            Some((Err(e), _)) => println!("{:<16} {e}", ""),
            None => {}
        }
    }
}

/// CPU time of this process so far, s (Linux; 0 elsewhere).
fn cpu_s() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let ticks = stat.split_whitespace().skip(13).take(2).filter_map(|x| x.parse::<f64>().ok());
    ticks.sum::<f64>() / 100.0
}

/// Geomview's OFF, for programs that judge or compete.
fn off(mesh: &TriMesh) -> String {
    let mut text = format!("OFF\n{} {} 0\n", mesh.vertices.len(), mesh.triangles.len());
    for p in &mesh.vertices {
        let [x, y, z] = p.to_array();
        text += &format!("{x:?} {y:?} {z:?}\n");
    }
    mesh.triangles.iter().for_each(|[a, b, c]| text += &format!("3 {a} {b} {c}\n"));
    text
}

fn main() {
    let argument = |k: usize| std::env::args().nth(k);
    let number = |k: usize, or: usize| argument(k).and_then(|a| a.parse().ok()).unwrap_or(or);
    let (count, first, folder) = (number(1, 200), number(2, 0), argument(3));
    let ctx = Ctx::new(0).unwrap();
    let (mut lines, mut refused, mut times) = (Vec::new(), 0, String::new());
    let mut keep = |line: Result<Line, Error>, name: &str, always: bool| match line {
        Ok(line) => {
            if !line.holds() || always || line.halvings > 0 {
                line.show();
            }
            if let Some(folder) = &folder {
                std::fs::write(format!("{folder}/{}.off", line.name.replace(' ', "-")), off(&line.mesh)).unwrap();
                if let Some([wall, cpu]) = line.alone {
                    times += &format!("{},{wall},{cpu}\n", line.name);
                }
            }
            lines.push(Line { mesh: TriMesh::default(), ..line });
        }
        Err(e) => {
            println!("{name:<16} refused: {e}");
            refused += 1;
        }
    };
    let benchmark = Phantom {
        field: fields::anastomosis(),
        seed: fields::tips()[0],
        cuts: vec![],
        euler: 2,
        branches: 0,
        sections: vec![],
    };
    for (name, sizing) in [("benchmark-.485", Sizing::Uniform(0.485)), ("benchmark-.02", Sizing::Curvature)] {
        keep(run(name, &benchmark, [0.0; 3], sizing, 0.02, &ctx), name, true);
    }
    for i in first..first + count {
        let mut dice = Dice(i as u64 * 977 + 1);
        let p = phantom(&mut dice, i);
        let shift = if i % 12 < 4 { [0.0; 3] } else { [dice.roll(), dice.roll(), dice.roll()] };
        for (name, sizing) in [("uniform", Sizing::Uniform(dice.between(0.4, 0.6))), ("adaptive", Sizing::Curvature)] {
            let name = format!("{i}-{name}");
            keep(run(&name, &p, shift, sizing, 0.03, &ctx), &name, i % 20 < 4);
        }
    }
    if let Some(folder) = &folder {
        std::fs::write(format!("{folder}/times.csv"), times).unwrap();
    }
    let missed = lines.iter().filter(|l| !l.holds()).count();
    let worst = |f: &dyn Fn(&Line) -> f64| lines.iter().map(f).fold(f64::NEG_INFINITY, f64::max);
    println!(
        "{} meshes, {missed} missed, {refused} refused; most calls {:.2}, angles {:.1} to {:.1}",
        lines.len(),
        worst(&Line::calls),
        -worst(&|l| -l.quality.min_angle_deg),
        worst(&|l| l.quality.max_angle_deg),
    );
    patched(&lines);
    assert!(missed + refused == 0, "{missed} meshes miss a bar, {refused} have none");
}

/// All walls as quadrilaterals in one line.
fn patched(lines: &[Line]) {
    let quads: Vec<&Quads> = lines.iter().filter_map(|l| l.quads.as_ref()?.0.as_ref().ok()).collect();
    let count = |f: &dyn Fn(&Quads) -> usize| quads.iter().map(|q| f(q)).sum::<usize>();
    let least = |f: &dyn Fn(&Quads) -> f64| quads.iter().map(|q| f(q)).fold(f64::INFINITY, f64::min);
    if quads.is_empty() {
        return;
    }
    println!(
        "{} walls as quadrilaterals: {} patches, {} poles, at most {:.4} mm, least sine {:.2}, least Jacobian {:.3} of the area",
        quads.len(),
        count(&|q| q.cells.len()),
        count(&|q| q.poles.len()),
        -least(&|q| -q.max_error_mm),
        least(&|q| q.least_sine),
        least(&|q| q.least_jacobian),
    );
}
