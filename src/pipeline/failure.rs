//! Any stage's error, carried to the process's edge.

use artefact::plan::{PlanFault, PlanFaults};
use space::{FaultKind, Faulty, Place};
use std::path::Path;

/// What ended a reconstruction, with the stage it ended in.
#[derive(Clone, Debug, thiserror::Error)]
#[error("{message}")]
pub struct Failure {
    /// Whose fault.
    pub kind: FaultKind,
    /// Stable machine code.
    pub code: &'static str,
    /// One sentence with numbers and what to do.
    pub message: String,
    /// Where.
    pub place: Place,
    /// Further faults of the same kind (a plan tells all at once).
    pub others: Vec<Failure>,
}

impl Failure {
    /// From any crate's error.
    pub fn of(e: &dyn Faulty) -> Self {
        Self { kind: e.kind(), code: e.code(), message: e.to_string(), place: e.place(), others: Vec::new() }
    }
    /// Our own fault.
    pub fn internal(e: impl std::fmt::Display) -> Self {
        Self::new(FaultKind::Internal, "internal", e.to_string())
    }
    /// A plan's faults, the first one leading.
    pub fn plan(faults: PlanFaults) -> Self {
        let mut all: Vec<Self> = faults.faults.iter().map(Self::of_plan).collect();
        if all.is_empty() {
            return Self::internal("a plan was refused without a fault");
        }
        let mut first = all.remove(0);
        first.others = all;
        first
    }
    fn of_plan(fault: &PlanFault) -> Self {
        let kind = if fault.code == "plan.too_large" { FaultKind::Limit } else { FaultKind::Input };
        let mut failure = Self::new(kind, fault.code, fault.message.clone());
        if !fault.field.is_empty() {
            failure.place = Place::field(&fault.field);
        }
        failure
    }
    /// A file that cannot be read.
    pub fn unreadable(path: &Path, e: &std::io::Error) -> Self {
        let mut failure = Self::new(FaultKind::Input, "input.unreadable", format!("cannot be read: {e}"));
        failure.place = Place::file(path.file_name().unwrap_or(path.as_os_str()).to_string_lossy());
        failure
    }
    pub(crate) fn new(kind: FaultKind, code: &'static str, message: String) -> Self {
        Self { kind, code, message, place: Place::none(), others: Vec::new() }
    }
}

impl Faulty for Failure {
    fn kind(&self) -> FaultKind {
        self.kind
    }
    fn code(&self) -> &'static str {
        self.code
    }
    fn place(&self) -> Place {
        self.place.clone()
    }
}
