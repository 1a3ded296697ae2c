//! Colours and words shared by the pictures, the plots, the report and the glTF file, so that a branch looks the same
//! everywhere.

use morphometry::Role;

/// Colour of a branch. Red, blue and green of the graft, the upstream and the downstream host differ in lightness too,
/// so that a grey print keeps them apart.
pub(crate) fn role_rgb(role: Role) -> [u8; 3] {
    match role {
        Role::Graft => [0xd1, 0x3f, 0x4f],
        Role::Proximal | Role::HostA => [0x1f, 0x5f, 0xb4],
        Role::Distal | Role::HostB => [0x1f, 0x9d, 0x6b],
        Role::Other => [0x6b, 0x6b, 0x76],
    }
}

/// Colours of the angle curves, in the order of the angles.
pub(crate) const ANGLE_RGB: [[u8; 3]; 6] = [
    [0x1f, 0x5f, 0xb4],
    [0xd1, 0x3f, 0x4f],
    [0x1f, 0x9d, 0x6b],
    [0x8a, 0x4f, 0xb0],
    [0xc9, 0x7b, 0x12],
    [0x44, 0x88, 0x99],
];

/// `#rrggbb`.
pub(crate) fn hex([r, g, b]: [u8; 3]) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// A role in words.
pub(crate) fn role_words(role: Role) -> &'static str {
    match role {
        Role::Graft => "graft",
        Role::Proximal => "proximal",
        Role::Distal => "distal",
        Role::HostA => "host A",
        Role::HostB => "host B",
        Role::Other => "other",
    }
}

/// An angle's name in words: `graft_distal_planar` is "graft to distal, within the plane".
pub(crate) fn angle_words(name: &str) -> String {
    const ROLES: [(&str, &str); 5] = [
        ("graft", "graft"),
        ("proximal", "proximal"),
        ("distal", "distal"),
        ("host_a", "host A"),
        ("host_b", "host B"),
    ];
    let take = |text: &str| {
        ROLES.iter().find_map(|(key, words)| {
            text.strip_prefix(key).map(|rest| (*words, rest.strip_prefix('_').unwrap_or(rest).to_owned()))
        })
    };
    let Some((first, rest)) = take(name) else { return name.replace('_', " ") };
    if rest == "normal" {
        return format!("{first} to the plane's normal");
    }
    match take(&rest) {
        Some((second, tail)) if tail.is_empty() => format!("{first} to {second}"),
        Some((second, tail)) if tail == "planar" => format!("{first} to {second}, within the plane"),
        _ => name.replace('_', " "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angle_names_become_words() {
        assert_eq!(angle_words("graft_distal_planar"), "graft to distal, within the plane");
        assert_eq!(angle_words("distal_normal"), "distal to the plane's normal");
        assert_eq!(angle_words("host_a_host_b"), "host A to host B");
        assert_eq!(angle_words("branch_3_branch_4"), "branch 3 branch 4");
    }
}
