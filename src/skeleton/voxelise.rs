//! From f to a binary volume.
//!
//! A voxel is object when f > 0 at its centre, inside the field's box and on the inner side of every cut plane. f costs
//! microseconds, so it is evaluated only at the corners of lattice cells that the wall passes through: from the cells at
//! the seeds, cell by cell across mixed faces (the continuation that polygonising uses, so that both see the same
//! pieces); the inside is then filled row by row. A vessel of 10 voxels radius takes .6 values per voxel of
//! its lumen, one of 15 .4 (measured), where a flood of the lumen takes more than one and the box some 15. What is not reached from a seed is not object: stray pieces where
//! f > 0 without data, and cavities without data inside the lumen.

use crate::{BitVolume, Error, Settings};
use exec::Ctx;
use imaging::CutPlane;
use implicit::Field;
use space::{Grid, P3, Place, V3, Warning};

/// Points per parallel piece of evaluation: some 1 ms at 5 us each, so that a cancel takes effect at once.
const PIECE: usize = 256;
/// Seeds looked at for the automatic spacing; the 5 % quantile then rests on the 13 smallest radii.
const SPACING_SEEDS: usize = 256;
/// Voxels per smallest radius of the automatic spacing (see [`Settings::spacing_mm`]).
const VOXELS_PER_RADIUS: f64 = 4.0;

/// Where the lumen is: f > 0 within the field's box, on the inner side of every cut plane.
#[derive(Clone, Copy)]
pub(crate) struct Domain<'a> {
    pub(crate) field: &'a dyn Field,
    pub(crate) cuts: &'a [CutPlane],
}

impl Domain<'_> {
    /// Whether a point lies on the data's side of the cut planes and within the field's box.
    pub(crate) fn has_data(&self, x: P3) -> bool {
        self.field.bounds().contains(x) && self.cuts.iter().all(|c| !c.excludes(x))
    }
    /// Whether a point is lumen.
    pub(crate) fn contains(&self, x: P3) -> bool {
        self.has_data(x) && self.field.value(x) > 0.0
    }
}

/// Half the chord of the lumen along the wall's normal at a seed (in the lumen or on its wall), mm: the radius of a
/// round vessel. `None` where the seed leads to no lumen.
fn half_chord(field: &dyn Field, seed: P3, step: f64) -> Option<f64> {
    let (mut x, (mut f, mut g)) = (seed, field.gradient(seed));
    for _ in 0..3 {
        if f > 0.0 {
            break;
        }
        let inward = g.normalised()?;
        x += inward * (-f / g.length().max(1e-3) + 0.25 * step).min(2.0 * step);
        (f, g) = field.gradient(x);
    }
    if f <= 0.0 {
        return None;
    }
    let normal = g.normalised().unwrap_or(V3::X);
    let limit = field.bounds().size().length();
    let reach = |direction: V3| {
        let mut t = 0.0;
        while t < limit && field.value(x + direction * t) > 0.0 {
            t += step;
        }
        t - 0.5 * step
    };
    Some(0.5 * (reach(normal) + reach(normal * -1.0)))
}

/// The lattice's spacing, mm: the user's, or a quarter of the smallest radius, but not finer than `automatic_voxels`
/// allows. A warning says when that leaves fewer than 2.5 voxels per radius.
pub(crate) fn spacing(
    field: &dyn Field,
    seeds: &[P3],
    settings: &Settings,
    ctx: &Ctx,
) -> Result<(f64, Option<Warning>), Error> {
    if let Some(h) = settings.spacing_mm {
        return Ok((h, None));
    }
    let size = field.bounds().size();
    let finest = (size.x() * size.y() * size.z() / settings.automatic_voxels as f64).cbrt();
    if !(finest.is_finite() && finest > 0.0) {
        return Err(Error::Unbounded);
    }
    let stride = seeds.len().div_ceil(SPACING_SEEDS).max(1);
    let some: Vec<P3> = seeds.iter().step_by(stride).copied().collect();
    let mut radii: Vec<f64> = ctx.map(&some, |&s| half_chord(field, s, 0.5 * finest))?.into_iter().flatten().collect();
    radii.sort_by(f64::total_cmp);
    let Some(&smallest) = radii.get(radii.len() / 20) else {
        return Err(Error::NoLumen { seeds: seeds.len(), at: seeds.first().copied() });
    };
    let h = finest.max(smallest / VOXELS_PER_RADIUS);
    let coarse = smallest < 2.5 * h;
    let message = format!(
        "the narrowest lumen has a radius of {smallest:.2} mm, only {:.1} voxels of {h:.3} mm; thin branches may be lost",
        smallest / h
    );
    Ok((h, coarse.then(|| Warning::new("skeleton.coarse", message, Place::none()))))
}

/// The lumen as a binary volume with its lattice (along the patient's axes, at least one voxel of background around).
/// `seeds` are points in the lumen or within two voxels of its wall: only pieces of the lumen whose outer wall is
/// reached from a seed are object.
///
/// # Errors
/// [`Error::Setting`], [`Error::Unbounded`], [`Error::TooManyVoxels`], [`Error::NoLumen`] when no seed leads to lumen,
/// [`Error::Cancelled`].
///
/// Cost: some three values of f per voxel of wall, in parallel; memory three bits per voxel of the box.
pub fn voxelise(
    field: &dyn Field,
    cuts: &[CutPlane],
    seeds: &[P3],
    settings: &Settings,
    ctx: &Ctx,
) -> Result<(BitVolume, Grid), Error> {
    settings.check()?;
    let (h, _) = spacing(field, seeds, settings, ctx)?;
    let grid = lattice(field, h, settings)?;
    let mut wall = Wall::new(Domain { field, cuts }, grid, h);
    let mut front = wall.cells_at(seeds, ctx)?;
    let mut generation = 0;
    while !front.is_empty() {
        generation += 1;
        wall.evaluate_corners(&front, ctx)?;
        front = wall.across_mixed_faces(&front);
        // The number of generations is not known beforehand; 100 is a vessel 100 voxels long seeded at one end.
        ctx.progress(1.0 - 1.0 / (1.0 + f64::from(generation) / 100.0));
    }
    wall.fill();
    if wall.inside.count() == 0 {
        return Err(Error::NoLumen { seeds: seeds.len(), at: seeds.first().copied() });
    }
    ctx.progress(1.0);
    Ok((wall.inside, grid))
}

fn lattice(field: &dyn Field, h: f64, settings: &Settings) -> Result<Grid, Error> {
    let bounds = field.bounds().grown(1.5 * h);
    let size = bounds.size();
    if !size.is_finite() {
        return Err(Error::Unbounded);
    }
    let count = |x: f64| (x / h).ceil().max(0.0) as u128 + 1;
    let voxels = count(size.x()).saturating_mul(count(size.y())).saturating_mul(count(size.z()));
    if voxels > settings.max_voxels as u128 {
        return Err(Error::TooManyVoxels { voxels, spacing_mm: h, limit: settings.max_voxels });
    }
    Ok(Grid::covering(bounds, h))
}

type Cell = [usize; 3];

/// The wall's cells as far as they are known. A cell has the number of its lowest corner.
struct Wall<'a> {
    domain: Domain<'a>,
    grid: Grid,
    spacing_mm: f64,
    visited: BitVolume,
    known: BitVolume,
    inside: BitVolume,
}

impl<'a> Wall<'a> {
    fn new(domain: Domain<'a>, grid: Grid, spacing_mm: f64) -> Self {
        let empty = BitVolume::new(grid.size);
        Self { domain, grid, spacing_mm, visited: empty.clone(), known: empty.clone(), inside: empty }
    }

    /// The cell that holds a point; `None` outside the lattice.
    fn cell_of(&self, x: P3) -> Option<Cell> {
        let v = (x - self.grid.point(0, 0, 0)).raw() / self.spacing_mm;
        let cell: [f64; 3] = v.to_array().map(f64::floor);
        (0..3).all(|a| cell[a] >= 0.0 && cell[a] + 1.0 < self.grid.size[a] as f64).then(|| cell.map(|x| x as usize))
    }

    /// The cells to start from: those around the wall that is nearest to each seed along its gradient.
    fn cells_at(&mut self, seeds: &[P3], ctx: &Ctx) -> Result<Vec<Cell>, Error> {
        let crossings = ctx.map(seeds, |&s| self.crossing(s))?;
        let at_wall: Vec<Cell> = crossings.into_iter().flatten().filter_map(|x| self.cell_of(x)).collect();
        let mut cells = Vec::new();
        for cell in at_wall {
            if self.visited.get(cell) {
                continue;
            }
            for d in 0..27 {
                let c = [cell[0] + d % 3, cell[1] + d / 3 % 3, cell[2] + d / 9];
                let c = c.map(|x| x.wrapping_sub(1));
                if (0..3).all(|a| c[a] + 1 < self.grid.size[a]) && !self.visited.get(c) {
                    self.visited.set(c);
                    cells.push(c);
                }
            }
        }
        Ok(cells)
    }

    /// Where the straight line from a seed down (from inside) or up (from outside, at most two voxels) its gradient
    /// meets the border of the lumen.
    fn crossing(&self, seed: P3) -> Option<P3> {
        let h = self.spacing_mm;
        let inside = self.domain.contains(seed);
        let (_, g) = self.domain.field.gradient(seed);
        let normal = g.normalised().unwrap_or(V3::X);
        let (step, limit) = if inside {
            (normal * (-0.5 * h), self.domain.field.bounds().size().length())
        } else {
            (normal * (0.5 * h), 2.0 * h)
        };
        let mut x = seed;
        for _ in 0..(limit / (0.5 * h)) as usize + 2 {
            let next = x + step;
            if self.domain.contains(next) != inside {
                return Some(x.lerp(next, 0.5));
            }
            x = next;
        }
        None
    }

    fn evaluate_corners(&mut self, cells: &[Cell], ctx: &Ctx) -> Result<(), Error> {
        let mut corners: Vec<Cell> = Vec::new();
        for corner in cells.iter().flat_map(|&c| (0..8).map(move |d| corner(c, d))) {
            if !self.known.get(corner) {
                self.known.set(corner);
                corners.push(corner);
            }
        }
        let pieces: Vec<&[Cell]> = corners.chunks(PIECE).collect();
        let signs = ctx.map(&pieces, |piece| self.signs(piece))?;
        for (&corner, sign) in corners.iter().zip(signs.into_iter().flatten()) {
            if sign {
                self.inside.set(corner);
            }
        }
        Ok(())
    }

    fn signs(&self, piece: &[Cell]) -> Vec<bool> {
        let points: Vec<P3> = piece.iter().map(|c| self.grid.point(c[0], c[1], c[2])).collect();
        let data: Vec<bool> = points.iter().map(|&x| self.domain.has_data(x)).collect();
        let asked: Vec<P3> = points.iter().zip(&data).filter(|(_, d)| **d).map(|(&x, _)| x).collect();
        let mut values = vec![0.0; asked.len()];
        self.domain.field.values(&asked, &mut values);
        let mut values = values.into_iter();
        data.into_iter().map(|d| d && values.next().is_some_and(|f| f > 0.0)).collect()
    }

    fn across_mixed_faces(&mut self, cells: &[Cell]) -> Vec<Cell> {
        let mut next = Vec::new();
        for &cell in cells {
            let signs = (0..8).fold(0_u8, |s, d| s | u8::from(self.inside.get(corner(cell, d))) << d);
            if signs == 0 || signs == 0xff {
                continue;
            }
            for (face, corners) in FACES.iter().enumerate() {
                if signs & corners == 0 || signs & corners == *corners {
                    continue;
                }
                let (axis, up) = (face / 2, face % 2 == 1);
                let mut c = cell;
                c[axis] = if up { cell[axis] + 1 } else { cell[axis].wrapping_sub(1) };
                if c[axis].wrapping_add(1) < self.grid.size[axis]
                    && c[axis] < self.grid.size[axis]
                    && !self.visited.get(c)
                {
                    self.visited.set(c);
                    next.push(c);
                }
            }
        }
        next
    }

    /// Unknown voxels take the side of the known voxel before them in their row: a change of side would have passed
    /// through cells of the wall.
    fn fill(&mut self) {
        let [nx, ny, nz] = self.grid.size;
        for (j, k) in (0..nz).flat_map(|k| (0..ny).map(move |j| (j, k))) {
            let mut inside = false;
            for w in 0..nx.div_ceil(64) {
                let at = self.known.row(j, k) + w;
                let known = self.known.words()[at];
                let last = (nx - 64 * w).min(64);
                if known == 0 && !inside {
                    continue;
                }
                let mut word = self.inside.words()[at];
                for b in 0..last {
                    if known >> b & 1 == 1 {
                        inside = word >> b & 1 == 1;
                    } else if inside {
                        word |= 1 << b;
                    }
                }
                self.inside.words_mut()[at] = word;
            }
        }
    }
}

/// Corner d of a cell: bit 0 of d steps along x, bit 1 along y, bit 2 along z.
fn corner(c: Cell, d: usize) -> Cell {
    [c[0] + (d & 1), c[1] + (d >> 1 & 1), c[2] + (d >> 2)]
}

/// Corners of each face as a mask: lower x, upper x, lower y, upper y, lower z, upper z.
const FACES: [u8; 6] = [0b0101_0101, 0b1010_1010, 0b0011_0011, 0b1100_1100, 0b0000_1111, 0b1111_0000];
