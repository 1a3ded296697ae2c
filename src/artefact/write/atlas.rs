//! slices.jpg and slices.json: the grey planes with the contours on them, for viewers that show them beside the surface.
//!
//! All planes lie as tiles in one picture, 8 bits, with one grey window for all; slices.json says where each tile lies in
//! the patient and holds the outlines in tile pixels. A viewer needs two small files instead of the scan, and nothing in
//! them but grey values and geometry can name a patient. Tiles have square pixels: a plane across the slices is
//! resampled as in the report's pictures. What exceeds [`MOST_PIXELS`] is first cropped to the vessel with room around
//! it, then made coarser. JPEG, not PNG: the noise of a scan does not compress without loss (docs/adr/0070), and nothing is
//! measured on these pictures.

use super::json::Json;
use super::slices::{Grey, even};
use super::{Error, SLICES_JPG, SLICES_JSON};
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use imaging::{Axis, Contours, Plane, Stack};
use space::{P3, V3};

/// Pixels of all tiles together: 1.7 MB at [`QUALITY`] on a scan as noisy as the demo's.
const MOST_PIXELS: f64 = 6e6;
/// Quality of the JPEG: 70 would save a quarter of the bytes, 90 cost a fifth more (docs/adr/0070).
const QUALITY: u8 = 85;
/// Most tiles; of more planes every second, third ... is taken.
const MOST_TILES: usize = 400;
/// Tiles of a stack without contours, which is looked at before sending.
const MOST_PREVIEWED: usize = 64;
/// Side of the shown part over the extent of the contours, where the whole would be too much.
const ROOM: f64 = 1.6;
/// Darkest and brightest parts of the pixels, which become black and white.
const WINDOW: [f64; 2] = [0.01, 0.998];
/// Most points of an outline in slices.json.
const MOST_POINTS: usize = 128;

/// The picture of all planes with what is needed to place them.
#[derive(Clone, Debug, PartialEq)]
pub struct Atlas {
    /// slices.jpg.
    pub jpeg: Vec<u8>,
    axis: &'static str,
    tile: [usize; 2],
    across: usize,
    pixel_mm: f64,
    u: V3,
    v: V3,
    /// Of the first tile pixel from the plane's first sample, along u and v, mm.
    offset_mm: [f64; 2],
    window: [f64; 2],
    tiles: Vec<Tile>,
}

#[derive(Clone, Debug, PartialEq)]
struct Tile {
    index: usize,
    origin: P3,
    /// In tile pixels, (0, 0) being the centre of the first.
    outlines: Vec<Vec<[f64; 2]>>,
}

/// A plane and its outlines in (u, v), mm.
struct Drawn<'a> {
    plane: &'a Plane,
    outlines: Vec<Vec<[f64; 2]>>,
}

/// The contour planes from the first to the last that carries a contour, two more on either side.
///
/// # Errors
/// [`Error::Mismatch`] for a curve of a plane that does not exist; [`Error::Encode`].
pub fn contour_atlas(stack: &Stack, contours: &Contours) -> Result<Option<Atlas>, Error> {
    let outlines = outlines(contours)?;
    let used = || contours.curves.iter().map(|c| c.plane);
    let (Some(first), Some(last)) = (used().min(), used().max()) else { return Ok(None) };
    let shown = first.saturating_sub(2)..(last + 3).min(contours.planes.len());
    let stride = shown.len().div_ceil(MOST_TILES);
    let drawn: Vec<Drawn<'_>> =
        shown.step_by(stride).map(|k| Drawn { plane: &contours.planes[k], outlines: outlines[k].clone() }).collect();
    atlas(stack, contours.axis, &drawn).map(Some)
}

/// The slices of a stack as they are, evenly thinned, with the contours where they were drawn on slices.
///
/// # Errors
/// As [`contour_atlas`].
pub fn stack_atlas(stack: &Stack, contours: Option<&Contours>) -> Result<Option<Atlas>, Error> {
    if stack.slices() == 0 || stack.columns == 0 || stack.rows == 0 {
        return Ok(None);
    }
    let on_slices = contours.filter(|c| c.axis == Axis::Slice);
    let outlines = on_slices.map(outlines).transpose()?;
    let planes: Vec<Plane> =
        (0..stack.slices()).step_by(stack.slices().div_ceil(MOST_PREVIEWED)).map(|k| slice_plane(stack, k)).collect();
    let of_slice = |index: usize| {
        let k = on_slices.and_then(|c| c.planes.iter().position(|p| p.index == index));
        outlines.as_ref().zip(k).map_or_else(Vec::new, |(all, k)| all[k].clone())
    };
    let drawn: Vec<Drawn<'_>> = planes.iter().map(|plane| Drawn { plane, outlines: of_slice(plane.index) }).collect();
    atlas(stack, Axis::Slice, &drawn).map(Some)
}

fn slice_plane(stack: &Stack, k: usize) -> Plane {
    let [row_step, column_step] = stack.pixel_spacing_mm;
    Plane {
        index: k,
        origin: stack.origins[k],
        u: stack.row_direction,
        v: stack.column_direction,
        u_mm: (0..stack.columns).map(|i| column_step * i as f64).collect(),
        v_mm: (0..stack.rows).map(|j| row_step * j as f64).collect(),
    }
}

/// Outlines of every plane in its (u, v), mm, thinned to [`MOST_POINTS`].
fn outlines(contours: &Contours) -> Result<Vec<Vec<Vec<[f64; 2]>>>, Error> {
    let mut all = vec![Vec::new(); contours.planes.len()];
    for (curve, line) in contours.curves.iter().zip(super::geometry::contour_lines(contours)?) {
        let plane = &contours.planes[curve.plane];
        let stride = line.points.len().div_ceil(MOST_POINTS).max(1);
        all[curve.plane].push(line.points.iter().step_by(stride).map(|&p| plane.in_plane(p)).collect());
    }
    Ok(all)
}

/// What part of the planes is shown and how finely: [first, last] along u and v, mm, and the side of a pixel, mm.
fn extent(drawn: &[Drawn<'_>]) -> ([[f64; 2]; 2], f64) {
    let whole = |offsets: fn(&Plane) -> &Vec<f64>| {
        drawn.iter().filter_map(|d| offsets(d.plane).last().copied()).fold(0.0, f64::max)
    };
    let whole = [[0.0, whole(|p| &p.u_mm)], [0.0, whole(|p| &p.v_mm)]];
    let native = drawn.iter().map(|d| even(&d.plane.u_mm).0.min(even(&d.plane.v_mm).0)).fold(f64::INFINITY, f64::min);
    let pixels = |part: &[[f64; 2]; 2], step: f64| {
        drawn.len() as f64 * part.iter().map(|[a, b]| (b - a) / step + 1.0).product::<f64>()
    };
    let part = if pixels(&whole, native) <= MOST_PIXELS { whole } else { around(drawn, whole) };
    // coarser by a few per cent until it fits: one pixel more per side makes the root inexact
    let mut step = native * (pixels(&part, native) / MOST_PIXELS).sqrt().max(1.0);
    while pixels(&part, step) > MOST_PIXELS {
        step *= 1.02;
    }
    (part, step)
}

/// The part around the outlines, with room, inside the whole; the whole without outlines.
fn around(drawn: &[Drawn<'_>], whole: [[f64; 2]; 2]) -> [[f64; 2]; 2] {
    let axis = |k: usize| {
        let values = drawn.iter().flat_map(|d| d.outlines.iter().flatten()).map(|p| p[k]);
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
        if low > high {
            return whole[k];
        }
        let (middle, half) = (0.5 * (low + high), 0.5 * ROOM * (high - low));
        [(middle - half).max(whole[k][0]), (middle + half).min(whole[k][1])]
    };
    [axis(0), axis(1)]
}

fn atlas(stack: &Stack, axis: Axis, drawn: &[Drawn<'_>]) -> Result<Atlas, Error> {
    let ([[u0, u1], [v0, v1]], step) = extent(drawn);
    let tile = [u1 - u0, v1 - v0].map(|length| (length / step + 1e-6) as usize + 1);
    let across = (((drawn.len() * tile[1]) as f64 / tile[0] as f64).sqrt().ceil() as usize).clamp(1, drawn.len());
    let size = [across * tile[0], drawn.len().div_ceil(across) * tile[1]];
    let samples = Grey::new(stack);
    let mut grey = vec![f64::NAN; size[0] * size[1]];
    for (k, d) in drawn.iter().enumerate() {
        let [left, top] = [k % across * tile[0], k / across * tile[1]];
        for (j, i) in (0..tile[1]).flat_map(|j| (0..tile[0]).map(move |i| (j, i))) {
            let p = d.plane.to_patient([u0 + step * i as f64, v0 + step * j as f64]);
            grey[(top + j) * size[0] + left + i] = samples.at(p);
        }
    }
    let window = window(&grey);
    let in_tile = |p: [f64; 2]| [(p[0] - u0) / step, (p[1] - v0) / step].map(|x| (x * 100.0).round() / 100.0);
    let tiles = drawn.iter().map(|d| Tile {
        index: d.plane.index,
        origin: d.plane.to_patient([u0, v0]),
        outlines: d.outlines.iter().map(|l| l.iter().map(|&p| in_tile(p)).collect()).collect(),
    });
    let (u, v) = drawn.first().map_or((V3::X, V3::Y), |d| (d.plane.u, d.plane.v));
    Ok(Atlas {
        jpeg: encoded(&grey, size, window)?,
        axis: super::slices::axis_name(axis),
        tile,
        across,
        pixel_mm: step,
        u,
        v,
        offset_mm: [u0, v0],
        window,
        tiles: tiles.collect(),
    })
}

/// Black and white, of a part of the pixels where there are many.
fn window(grey: &[f64]) -> [f64; 2] {
    let stride = (grey.len() >> 18).max(1);
    let mut some: Vec<f64> = grey.iter().step_by(stride).copied().filter(|g| g.is_finite()).collect();
    some.sort_by(f64::total_cmp);
    WINDOW.map(|part| some.get((part * some.len().saturating_sub(1) as f64) as usize).copied().unwrap_or(0.0))
}

fn encoded(grey: &[f64], size: [usize; 2], [black, white]: [f64; 2]) -> Result<Vec<u8>, Error> {
    let scale = 255.0 / (white - black).max(f64::MIN_POSITIVE);
    // a float to integer cast makes the NaN of an empty tile black
    let pixels: Vec<u8> = grey.iter().map(|g| ((g - black) * scale).round().clamp(0.0, 255.0) as u8).collect();
    let fault = |reason: String| Error::Encode { artefact: SLICES_JPG, reason };
    let side = |n: usize| u32::try_from(n).map_err(|e| fault(e.to_string()));
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, QUALITY)
        .encode(&pixels, side(size[0])?, side(size[1])?, ExtendedColorType::L8)
        .map_err(|e| fault(e.to_string()))?;
    Ok(jpeg)
}

impl Atlas {
    /// slices.json: `tile` [columns, rows] of a tile, `across` tiles in a row of the picture; `planes` in the order of the
    /// tiles, each with the patient position of its first pixel and its closed `contours` in tile pixels.
    ///
    /// # Errors
    /// [`Error::NotFinite`].
    pub fn json(&self) -> Result<Vec<u8>, Error> {
        let contour = |l: &Vec<[f64; 2]>| Json::list(l.iter().copied());
        let plane = |t: &Tile| {
            Json::Object(vec![
                ("index", t.index.into()),
                ("origin", t.origin.into()),
                ("contours", Json::List(t.outlines.iter().map(contour).collect())),
            ])
        };
        Json::Object(vec![
            ("schema", "vasculum/slices/1".into()),
            ("frame", "LPS".into()),
            ("image", SLICES_JPG.into()),
            ("axis", self.axis.into()),
            ("tile", Json::list(self.tile)),
            ("across", self.across.into()),
            ("pixel_mm", self.pixel_mm.into()),
            ("u", self.u.into()),
            ("v", self.v.into()),
            ("offset_mm", self.offset_mm.into()),
            ("window", self.window.into()),
            ("planes", Json::List(self.tiles.iter().map(plane).collect())),
        ])
        .print(SLICES_JSON)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    /// Grey = 10 column + row + 40 slice.
    fn stack(columns: usize, rows: usize, slices: usize) -> Stack {
        let value = |i: usize| (i % columns * 10 + i / columns % rows + i / (columns * rows) * 40) as f32;
        Stack {
            columns,
            rows,
            pixels: (0..columns * rows * slices).map(value).collect(),
            pixel_spacing_mm: [0.5, 0.5],
            row_direction: V3::X,
            column_direction: V3::Y,
            origins: (0..slices).map(|k| P3::new(10.0, 20.0, 2.0 * k as f64)).collect(),
            thickness_mm: None,
        }
    }

    #[test]
    fn every_tile_shows_its_own_slice() {
        let made = stack_atlas(&stack(24, 16, 5), None).unwrap().unwrap();
        assert_eq!((made.tile, made.tiles.len()), ([24, 16], 5));
        let picture = image::load_from_memory(&made.jpeg).unwrap().to_luma8();
        assert_eq!(picture.width() as usize, made.across * 24);
        let mean = |k: usize| {
            let [left, top] = [k % made.across * 24, k / made.across * 16];
            let sum: u32 = (0..24 * 16)
                .map(|i| u32::from(picture.get_pixel((left + i % 24) as u32, (top + i / 24) as u32)[0]))
                .sum();
            f64::from(sum) / 384.0
        };
        let wanted = |k: usize| {
            let middle = 115.0 + 7.5 + 40.0 * k as f64;
            (middle - made.window[0]) * 255.0 / (made.window[1] - made.window[0])
        };
        for k in 0..5 {
            assert!((mean(k) - wanted(k)).abs() < 3.0, "tile {k}: {} instead of {}", mean(k), wanted(k));
        }
    }

    #[test]
    fn what_is_too_much_is_cropped_to_the_vessel_and_made_coarser() {
        let plane = Plane {
            index: 0,
            origin: P3::ORIGIN,
            u: V3::X,
            v: V3::Y,
            u_mm: (0..1000).map(f64::from).collect(),
            v_mm: (0..1000).map(f64::from).collect(),
        };
        let outline = vec![[400.0, 500.0], [600.0, 500.0], [500.0, 700.0]];
        let few: Vec<Drawn<'_>> = (0..12).map(|_| Drawn { plane: &plane, outlines: vec![outline.clone()] }).collect();
        let (part, step) = extent(&few);
        assert_eq!((part, step), ([[340.0, 660.0], [440.0, 760.0]], 1.0));
        let many: Vec<Drawn<'_>> = (0..400).map(|_| Drawn { plane: &plane, outlines: vec![outline.clone()] }).collect();
        let (part, step) = extent(&many);
        assert_eq!(part, [[340.0, 660.0], [440.0, 760.0]]);
        let pixels = 400.0 * (320.0 / step + 1.0).powi(2);
        assert!(pixels <= MOST_PIXELS && pixels > 0.9 * MOST_PIXELS, "{pixels}");
    }

    #[test]
    fn the_geometry_leads_back_to_the_patient() {
        let made = stack_atlas(&stack(24, 16, 200), None).unwrap().unwrap();
        let told: serde_json::Value = serde_json::from_slice(&made.json().unwrap()).unwrap();
        assert_eq!(told["planes"].as_array().unwrap().len(), 50, "every fourth of 200");
        assert_eq!(told["planes"][7]["index"], 28);
        assert_eq!(told["planes"][7]["origin"], serde_json::json!([10.0, 20.0, 56.0]));
        assert_eq!((told["pixel_mm"].as_f64(), told["axis"].as_str()), (Some(0.5), Some("slice")));
    }
}
