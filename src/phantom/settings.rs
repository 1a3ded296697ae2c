//! What may be set of a simulated scan, with its defaults.

use crate::random::Stream;
use crate::{Bifurcation, Kind, SettingFault};
use space::P3;

/// Grey levels before bias field, blur and noise, in 0..4095.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Levels {
    /// The vessel's lumen. Default 1000.
    pub lumen: f64,
    /// The lumen of the unrelated vessels. Default 940: not to be told apart by brightness.
    pub distractor: f64,
    /// Tissue around, mean of its texture. Default 230 (a contrast-enhanced angiogram).
    pub tissue: f64,
    /// The rim of fat below the skin. Default 330.
    pub fat: f64,
    /// Outside the body. Default 0: air holds only the noise's Rician mean.
    pub air: f64,
}

impl Default for Levels {
    fn default() -> Self {
        Self { lumen: 1000.0, distractor: 940.0, tissue: 230.0, fat: 330.0, air: 0.0 }
    }
}

/// What surrounds the vessel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Body {
    /// An ellipse of tissue in air, unless the vessel would leave it within the stack: then as [`Body::FillsImage`].
    #[default]
    Auto,
    /// Tissue up to the image border.
    FillsImage,
}

/// Settings of a simulated scan. Lengths in mm, angles in degrees.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Pixels per row, 16..=2048. Default 256.
    pub columns: usize,
    /// Rows, 16..=2048. Default 256.
    pub rows: usize,
    /// Slices before some are left out, 1..=4096. Default 44: with 1.5 mm they hold 32 mm of the host on each side of
    /// the junction, 6.4 graft diameters.
    pub slices: usize,
    /// Edge of the square pixels, mm. Default 0.5.
    pub pixel_mm: f64,
    /// Distance between slice centres, mm. Default 1.5.
    pub slice_spacing_mm: f64,
    /// Thickness of a slice (box profile), mm; may differ from the spacing. Default 1.5.
    pub thickness_mm: f64,
    /// (lumen - tissue) / sigma, sigma the standard deviation of each of the two Gaussian channels behind the
    /// magnitude, both before the bias field. `None`: no noise. Default 20.
    pub snr: Option<f64>,
    /// Gaussian point spread within the slice, sigma in pixels, on top of the pixel's own box. Default 0.6.
    pub psf_sigma_px: f64,
    /// Largest relative change by the smooth multiplicative coil sensitivity, 0..0.9. Default 0.2.
    pub bias: f64,
    /// Relative standard deviation of the tissue's smooth texture, 0..0.5. Default 0.1.
    pub texture: f64,
    /// Number of unrelated bright vessels, 0..=3: the first straight and parallel to the host through the whole stack,
    /// the second an oblique gentle arc (radius 150 mm), the third a thin oblique straight one. Default 2.
    pub distractors: usize,
    /// Least distance between the walls of an unrelated vessel and of any other vessel, mm. Default 6.
    pub clearance_mm: f64,
    /// Seed of noise, texture, bias and the unrelated vessels' places. Default 1.
    pub seed: u64,
    /// Turns the vessel about the column direction, towards the row direction: 0 is along the slice normal, 90 within
    /// the slice (it then leaves through the image border). Default 0.
    pub tilt_deg: f64,
    /// Turns the vessel about the slice normal, after the tilt. Default 20, so that it follows no image axis.
    pub spin_deg: f64,
    /// The vessel's reference point (junction, middle of a tube) from the stack's centre along the row direction, the
    /// column direction and the normal, mm. The default keeps the graft's end in the image and the junction off the
    /// pixel and slice centres.
    pub shift_mm: [f64; 3],
    /// Centre of the stack in the patient, LPS mm. Default far from zero, so that a lost origin shows.
    pub centre_mm: P3,
    /// Turns of the acquisition about the patient's x, y and z axes, in this order; zero: axial slices.
    pub oblique_deg: [f64; 3],
    /// Slices left out, counted before leaving out; the others keep their true positions and their noise.
    pub missing_slices: Vec<usize>,
    /// Grey levels.
    pub levels: Levels,
    /// What surrounds the vessel.
    pub body: Body,
    /// Radius of tube, helix and sphere, mm. Default 3.
    pub tube_radius_mm: f64,
    /// Shape of anastomosis and trifurcation.
    pub bifurcation: Bifurcation,
    /// Curvature and torsion of the helix, 1/mm. Default 0.049 and 0.033.
    pub helix_per_mm: [f64; 2],
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            columns: 256,
            rows: 256,
            slices: 44,
            pixel_mm: 0.5,
            slice_spacing_mm: 1.5,
            thickness_mm: 1.5,
            snr: Some(20.0),
            psf_sigma_px: 0.6,
            bias: 0.2,
            texture: 0.1,
            distractors: 2,
            clearance_mm: 6.0,
            seed: 1,
            tilt_deg: 0.0,
            spin_deg: 20.0,
            shift_mm: [-12.37, -6.21, -0.41],
            centre_mm: P3::new(17.3, -42.6, 118.25),
            oblique_deg: [0.0; 3],
            missing_slices: Vec::new(),
            levels: Levels::default(),
            body: Body::Auto,
            tube_radius_mm: 3.0,
            bifurcation: Bifurcation::default(),
            helix_per_mm: [0.049, 0.033],
        }
    }
}

impl Settings {
    /// The defaults of a kind. For [`Kind::Random`] everything is drawn from its seed: pixels .4-.8 mm, slices 1-3 mm,
    /// SNR 8-30, 0-3 unrelated vessels, radii 2-5 mm, angles 20-90 degrees, any spin.
    pub fn of(kind: Kind) -> Self {
        let base = Self::default();
        match kind {
            Kind::Anastomosis | Kind::Trifurcation => base,
            Kind::Tube | Kind::Helix | Kind::Sphere => Self { shift_mm: [0.13, 0.21, 0.4], ..base },
            Kind::Random(seed) => Self::drawn(seed),
        }
    }

    fn drawn(seed: u64) -> Self {
        let draw = Stream::new(seed, 0x5ca2);
        let bifurcation = Bifurcation::drawn(seed);
        let pixel_mm = draw.between(0, 0.4, 0.8);
        let slice_spacing_mm = draw.between(1, 1.0, 3.0);
        // Room for 5 graft diameters along the host on both sides, and for what a small angle's crotch needs.
        let half_mm = 10.0 * bifurcation.graft_radius_mm + 12.0;
        let spin_deg = draw.between(4, 0.0, 360.0);
        let (sin, cos) = spin_deg.to_radians().sin_cos();
        let lean = 5.0 * bifurcation.graft_radius_mm * bifurcation.graft_deg.to_radians().sin();
        let jitter = |i| draw.between(i, -0.5, 0.5);
        Self {
            pixel_mm,
            slice_spacing_mm,
            thickness_mm: slice_spacing_mm,
            slices: (2.0 * half_mm / slice_spacing_mm).ceil() as usize + 1,
            snr: Some(draw.between(2, 8.0, 30.0)),
            distractors: (draw.uniform(3) * 4.0) as usize,
            spin_deg,
            shift_mm: [jitter(5) - lean * cos, jitter(6) - lean * sin, jitter(7)],
            seed,
            bifurcation,
            ..Self::default()
        }
    }

    /// Every fault of the settings.
    pub fn faults(&self) -> Vec<SettingFault> {
        let mut faults = Vec::new();
        let mut within = |field: &'static str, value: f64, low: f64, high: f64| {
            // The negation also catches NaN.
            if !(value >= low && value <= high) {
                faults.push(SettingFault { field, reason: format!("is {value} and must lie within {low} to {high}") });
            }
        };
        within("columns", self.columns as f64, 16.0, 2048.0);
        within("rows", self.rows as f64, 16.0, 2048.0);
        within("slices", self.slices as f64, 1.0, 4096.0);
        within("pixel_mm", self.pixel_mm, 0.05, 10.0);
        within("slice_spacing_mm", self.slice_spacing_mm, 0.05, 20.0);
        within("thickness_mm", self.thickness_mm, 0.0, 20.0);
        within("snr", self.snr.unwrap_or(1.0), 0.5, 1e6);
        within("psf_sigma_px", self.psf_sigma_px, 0.0, 5.0);
        within("bias", self.bias, 0.0, 0.9);
        within("texture", self.texture, 0.0, 0.5);
        within("distractors", self.distractors as f64, 0.0, 3.0);
        within("clearance_mm", self.clearance_mm, 0.5, 50.0);
        within("tilt_deg", self.tilt_deg, -180.0, 180.0);
        within("spin_deg", self.spin_deg, -360.0, 360.0);
        within("tube_radius_mm", self.tube_radius_mm, 0.2, 50.0);
        within("helix_per_mm", self.helix_per_mm[0], 0.001, 0.9 / self.tube_radius_mm);
        within("helix_per_mm", self.helix_per_mm[1], 0.001, 1.0);
        for v in self.shift_mm.into_iter().chain(self.centre_mm.to_array()).chain(self.oblique_deg) {
            within("shift_mm, centre_mm, oblique_deg", v, -1e5, 1e5);
        }
        let l = self.levels;
        for v in [l.lumen, l.distractor, l.tissue, l.fat, l.air] {
            within("levels", v, 0.0, 4095.0);
        }
        within("levels.tissue", l.tissue, 0.0, l.lumen - 1.0);
        for &k in &self.missing_slices {
            within("missing_slices", k as f64, 0.0, self.slices as f64 - 1.0);
        }
        self.bifurcation.faults(&mut within);
        if (0..self.slices.min(4096)).all(|k| self.missing_slices.contains(&k)) {
            faults.push(SettingFault { field: "missing_slices", reason: "leaves no slice".into() });
        }
        faults
    }
}
