//! What an operator does next, by a fault's code: the line that ends a fault on the command line. The portal has the same
//! advice in its own words, with the picture beside it (`service/portal/text`, `hint.*`).

/// By code, then by family; the first that fits counts.
const STEPS: &[(&str, &str)] = &[
    ("input.geometry_missing", "give geometry.pixel_spacing_mm and geometry.slice_spacing_mm in a plan (--plan)"),
    ("input.unreadable", "check the path and whether this user may read it"),
    ("input.", "look at what is understood: vasculum validate INPUT"),
    ("dicom.", "export the series again from the PACS, uncompressed if possible, and give it whole"),
    ("plan.", "mend the plan at the named field; vasculum validate INPUT --plan FILE tells every fault at once"),
    ("stack.", "give all slices of one series, each once"),
    ("mask.", "give the mask in the frame and size of the images"),
    ("segmentation.", "set segmentation.seeds_mm or segmentation.region of the plan on the vessel"),
    ("contours.", "look at the slices there; leave broken ones out (segmentation.exclude_slices) or set a seed"),
    ("implicit.", "give a stack that the vessel crosses in more slices, or set a seed on the vessel"),
    ("fit.", "leave out slices whose contours are wrong (segmentation.exclude_slices)"),
    (
        "surface.too_many_triangles",
        "ask for longer edges (surface.edge_mm) or a larger surface.max_error_mm in the plan",
    ),
    (
        "surface.too_many_cells",
        "ask for longer edges (surface.edge_mm), or leave out what is not the vessel (segmentation.region)",
    ),
    (
        "surface.",
        "look at the contours there: vessels that touch, a wrong slice; leave it out, set a seed, or cut (ends.cut_mm)",
    ),
    ("ends.", "put the point of ends.cut_mm on a medial line, clear of junctions and other vessels"),
    ("skeleton.", "look at the contours there: vessels that touch, or a wrong slice; leave it out or set a seed"),
    ("roles.", "give each role of the plan a point on or near a branch of its own"),
    ("variant.", "ask for a smaller change, or for another branch"),
    ("output.", "name a folder that does not exist yet, or one of an earlier run"),
];

/// The advice for a code, if there is any.
pub(crate) fn next_step(code: &str) -> Option<&'static str> {
    STEPS.iter().find(|(family, _)| code == *family || (family.ends_with('.') && code.starts_with(family))).map(|s| s.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_code_has_its_own_advice_or_its_familys() {
        assert!(next_step("input.unreadable").is_some_and(|s| s.contains("path")));
        assert!(next_step("input.empty").is_some_and(|s| s.contains("validate")));
        assert!(next_step("segmentation.no_vessel").is_some_and(|s| s.contains("seeds_mm")));
        assert!(next_step("surface.too_many_triangles").is_some_and(|s| s.contains("edge_mm")));
        assert_eq!(next_step("internal"), None);
        assert_eq!(next_step("inputs"), None);
    }
}
