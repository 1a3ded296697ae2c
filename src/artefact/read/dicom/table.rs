//! The allow-list: the only DICOM elements that are ever looked at. What is not here does not get past the parser, so
//! patient names, dates, private elements and free text never enter a structure of ours.

/// A tag as one number: group << 16 | element.
pub(crate) type Tag = u32;

pub(crate) const SOP_CLASS: Tag = 0x0008_0016;
pub(crate) const SOP_INSTANCE: Tag = 0x0008_0018;
pub(crate) const MODALITY: Tag = 0x0008_0060;
pub(crate) const THICKNESS: Tag = 0x0018_0050;
pub(crate) const REPETITION_TIME: Tag = 0x0018_0080;
pub(crate) const ECHO_TIME: Tag = 0x0018_0081;
pub(crate) const FIELD_STRENGTH: Tag = 0x0018_0087;
pub(crate) const STUDY: Tag = 0x0020_000d;
pub(crate) const SERIES: Tag = 0x0020_000e;
pub(crate) const SERIES_NUMBER: Tag = 0x0020_0011;
pub(crate) const INSTANCE_NUMBER: Tag = 0x0020_0013;
pub(crate) const POSITION: Tag = 0x0020_0032;
pub(crate) const ORIENTATION: Tag = 0x0020_0037;
pub(crate) const FRAME_OF_REFERENCE: Tag = 0x0020_0052;
pub(crate) const PLANE_POSITION_SEQUENCE: Tag = 0x0020_9113;
pub(crate) const PLANE_ORIENTATION_SEQUENCE: Tag = 0x0020_9116;
pub(crate) const SAMPLES_PER_PIXEL: Tag = 0x0028_0002;
pub(crate) const PHOTOMETRIC: Tag = 0x0028_0004;
pub(crate) const FRAMES: Tag = 0x0028_0008;
pub(crate) const ROWS: Tag = 0x0028_0010;
pub(crate) const COLUMNS: Tag = 0x0028_0011;
pub(crate) const PIXEL_SPACING: Tag = 0x0028_0030;
pub(crate) const BITS_ALLOCATED: Tag = 0x0028_0100;
pub(crate) const BITS_STORED: Tag = 0x0028_0101;
pub(crate) const HIGH_BIT: Tag = 0x0028_0102;
pub(crate) const PIXEL_REPRESENTATION: Tag = 0x0028_0103;
pub(crate) const BURNED_IN: Tag = 0x0028_0301;
pub(crate) const INTERCEPT: Tag = 0x0028_1052;
pub(crate) const SLOPE: Tag = 0x0028_1053;
pub(crate) const MODALITY_LUT: Tag = 0x0028_3000;
pub(crate) const PIXEL_MEASURES_SEQUENCE: Tag = 0x0028_9110;
pub(crate) const PIXEL_VALUE_SEQUENCE: Tag = 0x0028_9145;
pub(crate) const SHARED_GROUPS: Tag = 0x5200_9229;
pub(crate) const PER_FRAME_GROUPS: Tag = 0x5200_9230;
pub(crate) const SEGMENT_IDENTIFICATION: Tag = 0x0062_000a;
pub(crate) const REFERENCED_SEGMENT: Tag = 0x0062_000b;
pub(crate) const MAXIMUM_FRACTION: Tag = 0x0062_000e;
pub(crate) const PIXEL_DATA: Tag = 0x7fe0_0010;

/// Allowed elements with their value representation, ascending.
const ALLOWED: [(Tag, &[u8; 2]); 47] = [
    (SOP_CLASS, b"UI"),
    (SOP_INSTANCE, b"UI"),
    (MODALITY, b"CS"),
    (0x0018_0023, b"CS"), // MRAcquisitionType: 2D or 3D
    (THICKNESS, b"DS"),
    (0x0018_0060, b"DS"), // KVP
    (REPETITION_TIME, b"DS"),
    (ECHO_TIME, b"DS"),
    (FIELD_STRENGTH, b"DS"),
    (0x0018_0088, b"DS"), // SpacingBetweenSlices: kept for other readers, never used here
    (0x0018_1120, b"DS"), // GantryDetectorTilt
    (0x0018_1314, b"DS"), // FlipAngle
    (0x0018_5100, b"CS"), // PatientPosition
    (STUDY, b"UI"),
    (SERIES, b"UI"),
    (SERIES_NUMBER, b"IS"),
    (INSTANCE_NUMBER, b"IS"),
    (POSITION, b"DS"),
    (ORIENTATION, b"DS"),
    (FRAME_OF_REFERENCE, b"UI"),
    (PLANE_POSITION_SEQUENCE, b"SQ"),
    (PLANE_ORIENTATION_SEQUENCE, b"SQ"),
    (SAMPLES_PER_PIXEL, b"US"),
    (PHOTOMETRIC, b"CS"),
    (0x0028_0006, b"US"), // PlanarConfiguration
    (FRAMES, b"IS"),
    (ROWS, b"US"),
    (COLUMNS, b"US"),
    (PIXEL_SPACING, b"DS"),
    (BITS_ALLOCATED, b"US"),
    (BITS_STORED, b"US"),
    (HIGH_BIT, b"US"),
    (PIXEL_REPRESENTATION, b"US"),
    (BURNED_IN, b"CS"),
    (INTERCEPT, b"DS"),
    (SLOPE, b"DS"),
    (MODALITY_LUT, b"SQ"), // only to refuse it
    (PIXEL_MEASURES_SEQUENCE, b"SQ"),
    (PIXEL_VALUE_SEQUENCE, b"SQ"),
    (SEGMENT_IDENTIFICATION, b"SQ"),
    (REFERENCED_SEGMENT, b"US"),
    (MAXIMUM_FRACTION, b"US"),
    (SHARED_GROUPS, b"SQ"),
    (PER_FRAME_GROUPS, b"SQ"),
    (0x7fe0_0008, b"OF"), // FloatPixelData: only to refuse it
    (0x7fe0_0009, b"OD"), // DoubleFloatPixelData: only to refuse it
    (PIXEL_DATA, b"OW"),
];

/// The value representation of an allowed element; `None` for all others.
pub(crate) fn representation(tag: Tag) -> Option<&'static [u8; 2]> {
    ALLOWED.binary_search_by_key(&tag, |(t, _)| *t).ok().map(|i| ALLOWED[i].1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_is_sorted_and_names_no_patient() {
        assert!(ALLOWED.windows(2).all(|w| w[0].0 < w[1].0));
        assert!(ALLOWED.iter().all(|(t, _)| t >> 16 != 0x0010 && (t >> 16) % 2 == 0), "no patient, no private group");
    }
}
