//! Faults as RFC 9457 problem documents, and in plain words for a terminal.
//!
//! One body serves the API, `vasculum run --json` and the `error` member of a job, so that a script reads the same
//! `code` and `where` everywhere.

use serde::{Deserialize, Serialize};
use space::{FaultKind, Faulty, Place};
use std::fmt::Write as _;

/// Prefix of `type`; the rest is the code, so that the type identifies the fault and `docs/codes.md` explains it.
pub const TYPE_PREFIX: &str = "urn:vasculum:fault:";

/// The wire form of [`space::Place`]: only what is known is written.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Where {
    /// File of the upload.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub file: Option<String>,
    /// Field of the plan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// Slice, from 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub slice: Option<usize>,
    /// Contour within its slice.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub contour: Option<usize>,
    /// Mesh element, graph node or edge.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub element: Option<usize>,
    /// LPS mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position: Option<[f64; 3]>,
}

impl Where {
    /// `None` for a place that says nothing. A position that is not finite is left out.
    pub fn of(place: &Place) -> Option<Self> {
        let position = place.position.filter(|p| p.is_finite()).map(|p| p.to_array());
        let it = Self {
            file: place.file.clone(),
            field: place.field.clone(),
            slice: place.slice,
            contour: place.contour,
            element: place.element,
            position,
        };
        (it != Self::default()).then_some(it)
    }
    /// Back to the domain's type.
    pub fn place(&self) -> Place {
        Place {
            file: self.file.clone(),
            field: self.field.clone(),
            slice: self.slice,
            contour: self.contour,
            element: self.element,
            position: self.position.map(Into::into),
        }
    }
}

/// One fault among several.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Fault {
    /// Machine code.
    pub code: String,
    /// What is wrong and what to do.
    pub detail: String,
    /// Where.
    #[serde(rename = "where", default, skip_serializing_if = "Option::is_none")]
    pub place: Option<Where>,
}

impl Fault {
    /// From any fault of ours.
    pub fn of(fault: &dyn Faulty) -> Self {
        Self { code: fault.code().to_owned(), detail: fault.to_string(), place: Where::of(&fault.place()) }
    }
}

/// An RFC 9457 body (`application/problem+json`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Problem {
    /// [`TYPE_PREFIX`] and the code.
    #[serde(rename = "type")]
    pub kind: String,
    /// One line that depends on the kind of fault only.
    pub title: String,
    /// HTTP status.
    pub status: u16,
    /// What is wrong, with numbers, and what to do next.
    pub detail: String,
    /// The resource concerned, such as `/v1/jobs/ID`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub instance: Option<String>,
    /// Machine code such as `contour.open`.
    pub code: String,
    /// Where the fault lies.
    #[serde(rename = "where", default, skip_serializing_if = "Option::is_none")]
    pub place: Option<Where>,
    /// Finds the request in the log.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trace_id: Option<String>,
    /// All faults, the first one included, when there are several.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub errors: Vec<Fault>,
}

/// HTTP status of a kind of fault.
pub fn status(kind: FaultKind) -> u16 {
    match kind {
        FaultKind::Input | FaultKind::Numeric => 422,
        FaultKind::Limit => 413,
        FaultKind::Cancelled => 409,
        FaultKind::Internal => 500,
    }
}

fn title(kind: FaultKind) -> &'static str {
    match kind {
        FaultKind::Input => "The scan or the plan cannot be used as it is",
        FaultKind::Limit => "A stated limit was met",
        FaultKind::Numeric => "The reconstruction did not succeed on this scan",
        FaultKind::Cancelled => "The job was cancelled",
        FaultKind::Internal => "A fault of the service",
    }
}

impl Problem {
    /// From one fault.
    pub fn of(fault: &dyn Faulty) -> Self {
        let Fault { code, detail, place } = Fault::of(fault);
        Self {
            kind: format!("{TYPE_PREFIX}{code}"),
            title: title(fault.kind()).to_owned(),
            status: status(fault.kind()),
            detail,
            instance: None,
            code,
            place,
            trace_id: None,
            errors: Vec::new(),
        }
    }
    /// From several faults found at once: the first one gives kind, code and detail, all are listed in `errors`. `None`
    /// when there is none.
    pub fn of_all<'a>(faults: impl IntoIterator<Item = &'a dyn Faulty>) -> Option<Self> {
        let faults: Vec<&dyn Faulty> = faults.into_iter().collect();
        let mut problem = Self::of(*faults.first()?);
        if faults.len() > 1 {
            problem.errors = faults.iter().map(|f| Fault::of(*f)).collect();
        }
        Some(problem)
    }
    /// A problem that no crate's error describes (such as an unknown route), by its status.
    pub fn new(status: u16, code: &str, title: &str, detail: impl Into<String>) -> Self {
        Self {
            kind: format!("{TYPE_PREFIX}{code}"),
            title: title.to_owned(),
            status,
            detail: detail.into(),
            instance: None,
            code: code.to_owned(),
            place: None,
            trace_id: None,
            errors: Vec::new(),
        }
    }
    /// With the resource concerned.
    #[must_use]
    pub fn with_instance(mut self, instance: impl Into<String>) -> Self {
        self.instance = Some(instance.into());
        self
    }
    /// With the trace id of the request.
    #[must_use]
    pub fn with_trace(mut self, trace_id: impl Into<String>) -> Self {
        self.trace_id = Some(trace_id.into());
        self
    }
    /// The same without the inner words of a fault of ours, which belong into the log: the trace id finds them there.
    #[must_use]
    pub fn for_client(mut self) -> Self {
        if self.status >= 500 {
            self.detail =
                "The service met a fault of its own; nothing is wrong with the scan. Try again, and give the \
                           trace id to the operator if it happens twice."
                    .to_owned();
            self.errors.clear();
        }
        self
    }
    /// Plain words for a terminal: what, where, what to do next, the code, and so for all further faults. No colour, ends with a newline.
    pub fn plain(&self) -> String {
        let mut out = format!("{}.\n", self.title);
        let several = [Fault { code: self.code.clone(), detail: self.detail.clone(), place: self.place.clone() }];
        let faults = if self.errors.is_empty() { &several[..] } else { &self.errors };
        for f in faults {
            // Writing into a String cannot fail.
            let _ = write!(out, "  {}", f.detail);
            if let Some(place) = &f.place {
                let _ = write!(out, "\n    where: {}", place.place());
            }
            if let Some(step) = crate::next::next_step(&f.code) {
                let _ = write!(out, "\n    next:  {step}");
            }
            let _ = writeln!(out, "\n    code:  {}", f.code);
        }
        if let Some(id) = &self.trace_id {
            let _ = writeln!(out, "  trace: {id}");
        }
        out
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("contour {0} of slice 7 is open; add a seed or exclude the slice")]
    struct Open(usize, FaultKind);
    impl Faulty for Open {
        fn kind(&self) -> FaultKind {
            self.1
        }
        fn code(&self) -> &'static str {
            "contour.open"
        }
        fn place(&self) -> Place {
            Place::contour(7, self.0)
        }
    }

    #[test]
    fn a_fault_becomes_a_problem_with_code_and_place() {
        let p = Problem::of(&Open(2, FaultKind::Input)).with_instance("/v1/jobs/1").with_trace("abc");
        let v = serde_json::to_value(&p).unwrap();
        assert_eq!(v["type"], "urn:vasculum:fault:contour.open");
        assert_eq!(v["status"], 422);
        assert_eq!(v["where"], serde_json::json!({"slice": 7, "contour": 2}));
        assert_eq!(v["code"], "contour.open");
        assert_eq!(v["instance"], "/v1/jobs/1");
        assert!(v.get("errors").is_none());
        let back: Problem = serde_json::from_value(v).unwrap();
        assert_eq!(back, p);
    }

    #[test]
    fn every_kind_has_its_status() {
        let kinds = [FaultKind::Input, FaultKind::Limit, FaultKind::Numeric, FaultKind::Cancelled, FaultKind::Internal];
        assert_eq!(kinds.map(status), [422, 413, 422, 409, 500]);
    }

    #[test]
    fn several_faults_are_all_told() {
        let (a, b) = (Open(1, FaultKind::Input), Open(2, FaultKind::Input));
        let p = Problem::of_all([&a as &dyn Faulty, &b]).unwrap();
        assert_eq!(p.errors.len(), 2);
        let text = p.plain();
        assert!(text.contains("contour 1 of slice 7") && text.contains("where: slice 7, contour 2"), "{text}");
        assert!(Problem::of_all([]).is_none());
    }

    #[test]
    fn the_command_line_tells_what_to_do_next() {
        let p = Problem::new(422, "segmentation.no_vessel", "The scan cannot be used", "no vessel was found");
        assert!(p.plain().contains("next:  set segmentation.seeds_mm"), "{}", p.plain());
    }

    #[test]
    fn our_own_fault_keeps_its_words_from_the_client() {
        let p = Problem::of(&Open(1, FaultKind::Internal)).with_trace("abc").for_client();
        assert!(!p.detail.contains("contour 1") && p.trace_id.as_deref() == Some("abc"));
        let input = Problem::of(&Open(1, FaultKind::Input)).for_client();
        assert!(input.detail.contains("contour 1"));
    }
}
