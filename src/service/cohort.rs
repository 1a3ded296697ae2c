//! The table of many results, as far as the service knows it: who fills it, and what of it is wanted. What a result
//! says is read by the binary's hook, the same code that `vasculum cohort` runs.

use crate::error::Problem;
use serde::Deserialize;

/// What of the results is wanted; an empty list means all.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// Names of angles and roles of branches.
    pub names: Vec<String>,
    /// Quantities.
    pub quantities: Vec<String>,
    /// `angle` or `branch`.
    pub kinds: Vec<String>,
    /// Numbers of branches.
    pub branches: Vec<u64>,
    /// Leave out results with warnings.
    pub without_warnings: bool,
}

/// Where a result comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Source {
    /// The job's id.
    pub job: String,
    /// RFC 3339, UTC.
    pub created_at: Option<String>,
}

/// A table that is filled result by result and holds no more of them than its rows.
pub trait Table: Send {
    /// Takes what is wanted of a result.json.
    ///
    /// # Errors
    /// A result that cannot be read.
    fn add(&mut self, source: &Source, result: &[u8]) -> Result<(), Problem>;

    /// The table as JSON.
    ///
    /// # Errors
    /// A fault of our own.
    fn json(&self) -> Result<Vec<u8>, Problem>;

    /// Its rows as CSV.
    ///
    /// # Errors
    /// A fault of our own.
    fn csv(&self) -> Result<Vec<u8>, Problem>;
}

/// Makes an empty table.
pub type NewTable = fn(Wanted) -> Box<dyn Table>;

/// A table without rows, for a service without a reader of results.
pub(crate) fn count(_: Wanted) -> Box<dyn Table> {
    Box::new(Count(Vec::new()))
}

struct Count(Vec<String>);

impl Table for Count {
    fn add(&mut self, source: &Source, _: &[u8]) -> Result<(), Problem> {
        self.0.push(source.job.clone());
        Ok(())
    }

    fn json(&self) -> Result<Vec<u8>, Problem> {
        let results: Vec<_> = self.0.iter().map(|job| serde_json::json!({"job": job})).collect();
        let told =
            serde_json::json!({"schema": "", "jobs": results.len(), "results": results, "rows": [], "summary": []});
        Ok(told.to_string().into_bytes())
    }

    fn csv(&self) -> Result<Vec<u8>, Problem> {
        Ok([&["job"], &self.0.iter().map(String::as_str).collect::<Vec<_>>()[..]].concat().join("\r\n").into_bytes())
    }
}

/// A number that is compared over results.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// Diameter of a branch.
    DiameterMm,
    /// Length of a branch.
    LengthMm,
    /// Length over the distance of its ends.
    Tortuosity,
    /// Median of the whole sections outside junctions.
    AreaMm2,
    /// Narrowest area over that of its surroundings.
    StenosisAreaRatio,
    /// Curvature of the helix or arc.
    HelixCurvaturePerMm,
    /// Torsion of the helix.
    HelixTorsionPerMm,
    /// Radius of the helix.
    HelixRadiusMm,
    /// An angle.
    Deg,
}

impl Quantity {
    /// All of them.
    pub const ALL: [Self; 9] = [
        Self::DiameterMm,
        Self::LengthMm,
        Self::Tortuosity,
        Self::AreaMm2,
        Self::StenosisAreaRatio,
        Self::HelixCurvaturePerMm,
        Self::HelixTorsionPerMm,
        Self::HelixRadiusMm,
        Self::Deg,
    ];

    /// The word in the query and in the table.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::DiameterMm => "diameter_mm",
            Self::LengthMm => "length_mm",
            Self::Tortuosity => "tortuosity",
            Self::AreaMm2 => "area_mm2",
            Self::StenosisAreaRatio => "stenosis_area_ratio",
            Self::HelixCurvaturePerMm => "helix_curvature_per_mm",
            Self::HelixTorsionPerMm => "helix_torsion_per_mm",
            Self::HelixRadiusMm => "helix_radius_mm",
            Self::Deg => "deg",
        }
    }
}
