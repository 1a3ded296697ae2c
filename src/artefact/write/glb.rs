//! surface.glb: the surface and the medial lines as binary glTF 2.0.
//!
//! glTF wants metres and Y up; the patient frame is LPS in mm with z to the head. The map used is
//! (x, y, z) mm -> (x, z, -y) / 1000 m, a rotation by -90 degrees about x (right-handed to right-handed): +X patient
//! left, +Y head, +Z anterior, so that a viewer in its default pose sees the patient from the front. Positions keep the
//! patient's origin.
//!
//! One mesh `surface` (primitive 0 the wall with smooth normals, then one primitive per cap with its flat normal), each
//! vertex with `_DISPLACEMENT_MM` (a custom attribute instead of COLOR_0, which every viewer would multiply into the
//! surface's colour). The medial lines are LINE_STRIP primitives with `_RADIUS_MM` in nodes of their own, named by the
//! branch's role (role and number where a role occurs twice). `extras` carry names and units.

use super::geometry::{checked_mesh, vertex_normals};
use super::{Error, SURFACE_GLB};
use crate::Reconstruction;
use crate::reconstruction::CapFacts;
use gltf_json as gltf;
use gltf_json::validation::{Checked, USize64};
use gltf_json::{Index, accessor, buffer, material, mesh, scene};
use morphometry::Role;
use serde_json::{Value, json};
use space::{P3, V3};
use std::collections::BTreeMap;
use surface::WALL;

/// Opacity of the wall, so that the medial lines inside are seen.
const WALL_OPACITY: f32 = 0.55;

/// LPS mm to glTF metres, Y up.
pub fn gltf_position(p: P3) -> [f32; 3] {
    [p.x() / 1000.0, p.z() / 1000.0, -p.y() / 1000.0].map(|x| x as f32)
}

fn gltf_direction(v: V3) -> [f32; 3] {
    [v.x() as f32, v.z() as f32, -v.y() as f32]
}

/// The document while it grows.
struct Builder {
    root: gltf::Root,
    binary: Vec<u8>,
    buffer: Index<buffer::Buffer>,
}

/// Numbers of one vertex attribute.
enum Attribute<'a> {
    Triples(&'a [[f32; 3]]),
    Scalars(&'a [f32]),
}

impl Builder {
    fn new() -> Self {
        let mut root = gltf::Root::default();
        root.asset.generator = Some("vasculum".to_owned());
        root.asset.extras = extras(&json!({
            "length_unit": "m",
            "axes": "+X patient left, +Y head, +Z anterior",
            "from_lps_mm": "(x, y, z) mm -> (x, z, -y) / 1000 m",
            "attributes": {"_DISPLACEMENT_MM": "signed displacement by smoothing, mm", "_RADIUS_MM": "radius of the largest inscribed sphere, mm"}
        }));
        let buffer = root.push(buffer::Buffer {
            byte_length: USize64(0),
            name: None,
            uri: None,
            extensions: None,
            extras: None,
        });
        Self { root, binary: Vec::new(), buffer }
    }

    fn view(&mut self, bytes: &[u8], target: buffer::Target) -> Index<buffer::View> {
        let offset = self.binary.len();
        self.binary.extend_from_slice(bytes);
        self.root.push(buffer::View {
            buffer: self.buffer,
            byte_length: USize64::from(bytes.len()),
            byte_offset: Some(USize64::from(offset)),
            byte_stride: None,
            name: None,
            target: Some(Checked::Valid(target)),
            extensions: None,
            extras: None,
        })
    }

    fn accessor(
        &mut self,
        view: Index<buffer::View>,
        count: usize,
        component: accessor::ComponentType,
        kind: accessor::Type,
        bounds: Option<(Value, Value)>,
    ) -> Index<accessor::Accessor> {
        let (min, max) = bounds.unzip();
        self.root.push(accessor::Accessor {
            buffer_view: Some(view),
            byte_offset: Some(USize64(0)),
            count: USize64::from(count),
            component_type: Checked::Valid(accessor::GenericComponentType(component)),
            extensions: None,
            extras: None,
            type_: Checked::Valid(kind),
            min,
            max,
            name: None,
            normalized: false,
            sparse: None,
        })
    }

    fn attribute(&mut self, semantic: &mesh::Semantic, values: Attribute<'_>) -> Index<accessor::Accessor> {
        let (bytes, count, kind): (Vec<u8>, usize, _) = match values {
            Attribute::Triples(v) => {
                (v.iter().flatten().flat_map(|x| x.to_le_bytes()).collect(), v.len(), accessor::Type::Vec3)
            }
            Attribute::Scalars(v) => {
                (v.iter().flat_map(|x| x.to_le_bytes()).collect(), v.len(), accessor::Type::Scalar)
            }
        };
        // glTF demands bounds of the positions, exactly as stored.
        let bounds = match (semantic, values) {
            (mesh::Semantic::Positions, Attribute::Triples(v)) => {
                let fold = |f: fn(f32, f32) -> f32, start: f32| {
                    v.iter().fold([start; 3], |a, p| [f(a[0], p[0]), f(a[1], p[1]), f(a[2], p[2])])
                };
                Some((json!(fold(f32::min, f32::INFINITY)), json!(fold(f32::max, f32::NEG_INFINITY))))
            }
            _ => None,
        };
        let view = self.view(&bytes, buffer::Target::ArrayBuffer);
        self.accessor(view, count, accessor::ComponentType::F32, kind, bounds)
    }

    fn attributes(
        &mut self,
        list: Vec<(mesh::Semantic, Attribute<'_>)>,
    ) -> BTreeMap<Checked<mesh::Semantic>, Index<accessor::Accessor>> {
        list.into_iter()
            .map(|(s, a)| {
                let i = self.attribute(&s, a);
                (Checked::Valid(s), i)
            })
            .collect()
    }

    fn indices(&mut self, indices: &[u32]) -> Index<accessor::Accessor> {
        let bytes: Vec<u8> = indices.iter().flat_map(|x| x.to_le_bytes()).collect();
        let view = self.view(&bytes, buffer::Target::ElementArrayBuffer);
        self.accessor(view, indices.len(), accessor::ComponentType::U32, accessor::Type::Scalar, None)
    }

    fn material(&mut self, name: &str, rgba: [f32; 4], look: Look) -> Index<material::Material> {
        let line = matches!(look, Look::Line);
        self.root.push(material::Material {
            name: Some(name.to_owned()),
            alpha_mode: Checked::Valid(if rgba[3] < 1.0 {
                material::AlphaMode::Blend
            } else {
                material::AlphaMode::Opaque
            }),
            double_sided: !line,
            pbr_metallic_roughness: material::PbrMetallicRoughness {
                base_color_factor: material::PbrBaseColorFactor(rgba),
                metallic_factor: material::StrengthFactor(0.0),
                roughness_factor: material::StrengthFactor(if line { 1.0 } else { 0.55 }),
                ..Default::default()
            },
            emissive_factor: material::EmissiveFactor(if line { [rgba[0], rgba[1], rgba[2]] } else { [0.0; 3] }),
            ..Default::default()
        })
    }

    fn node(&mut self, name: String, mesh: mesh::Mesh, about: &Value) -> Index<scene::Node> {
        let mesh = self.root.push(mesh);
        self.root.push(scene::Node { name: Some(name), mesh: Some(mesh), extras: extras(about), ..Default::default() })
    }

    /// The container: header, JSON chunk padded with spaces, binary chunk padded with zeros.
    fn finish(mut self, nodes: Vec<Index<scene::Node>>) -> Result<Vec<u8>, Error> {
        let scene =
            self.root.push(scene::Scene { name: Some("vessel".to_owned()), nodes, extensions: None, extras: None });
        self.root.scene = Some(scene);
        self.root.buffers[0].byte_length = USize64::from(self.binary.len());
        if self.binary.is_empty() {
            self.root.buffers.clear();
        }
        let mut text = gltf::serialize::to_vec(&self.root)
            .map_err(|e| Error::Encode { artefact: SURFACE_GLB, reason: e.to_string() })?;
        text.resize(text.len().next_multiple_of(4), b' ');
        self.binary.resize(self.binary.len().next_multiple_of(4), 0);
        let total = 12 + 8 + text.len() as u64 + 8 + self.binary.len() as u64;
        let length = |n: u64| {
            u32::try_from(n).map_err(|_| Error::TooLarge {
                artefact: SURFACE_GLB,
                bytes: total,
                limit: u64::from(u32::MAX),
            })
        };
        let mut out = Vec::with_capacity(usize::try_from(total).unwrap_or(0));
        out.extend_from_slice(b"glTF");
        out.extend_from_slice(&2u32.to_le_bytes());
        out.extend_from_slice(&length(total)?.to_le_bytes());
        out.extend_from_slice(&length(text.len() as u64)?.to_le_bytes());
        out.extend_from_slice(b"JSON");
        out.append(&mut text);
        out.extend_from_slice(&length(self.binary.len() as u64)?.to_le_bytes());
        out.extend_from_slice(b"BIN\0");
        out.append(&mut self.binary);
        Ok(out)
    }
}

/// How a material looks.
#[derive(Clone, Copy)]
enum Look {
    Surface,
    Line,
}

fn extras(value: &Value) -> gltf::extras::Extras {
    gltf::extras::RawValue::from_string(value.to_string()).ok()
}

/// surface.glb.
///
/// # Errors
/// [`Error::Mismatch`], [`Error::NotFinite`]; [`Error::TooLarge`] beyond 4 GiB.
pub fn surface_glb(r: &Reconstruction<'_>) -> Result<Vec<u8>, Error> {
    let mesh = r.surface.mesh;
    checked_mesh(SURFACE_GLB, mesh)?;
    let positions: Vec<f64> = mesh.vertices.iter().flat_map(|p| p.to_array()).collect();
    super::error::all_finite(SURFACE_GLB, "positions", &positions)?;
    super::error::all_finite(SURFACE_GLB, "_DISPLACEMENT_MM", r.surface.displacement_mm)?;
    let mut b = Builder::new();
    let mut nodes = Vec::new();
    let primitives = surface_primitives(&mut b, r);
    if !primitives.is_empty() {
        let about = json!({"displacement_unit": "mm", "area_mm2": r.surface.quality.area_mm2, "volume_mm3": r.surface.quality.volume_mm3});
        let mesh =
            mesh::Mesh { extensions: None, extras: None, name: Some("surface".to_owned()), primitives, weights: None };
        nodes.push(b.node("surface".to_owned(), mesh, &about));
    }
    nodes.extend(medial_lines(&mut b, r)?);
    b.finish(nodes)
}

fn surface_primitives(b: &mut Builder, r: &Reconstruction<'_>) -> Vec<mesh::Primitive> {
    let mesh = r.surface.mesh;
    let smooth = vertex_normals(mesh);
    let wall = b.material("wall", [0.85, 0.72, 0.68, WALL_OPACITY], Look::Surface);
    let cap = b.material("cap", [0.55, 0.62, 0.72, WALL_OPACITY], Look::Surface);
    let mut ids = mesh.face_id.clone();
    ids.sort_unstable();
    ids.dedup();
    ids.into_iter()
        .map(|face| {
            let triangles: Vec<usize> = (0..mesh.triangles.len()).filter(|&t| mesh.face_id[t] == face).collect();
            let flat = triangles.iter().fold(V3::ZERO, |s, &t| s + mesh.area_vector(t)).normalised().unwrap_or(V3::Z);
            let mut local = BTreeMap::new();
            let mut used = Vec::new();
            let mut indices = Vec::with_capacity(3 * triangles.len());
            for &v in triangles.iter().flat_map(|&t| &mesh.triangles[t]) {
                let index = *local.entry(v).or_insert_with(|| {
                    used.push(v as usize);
                    (used.len() - 1) as u32
                });
                indices.push(index);
            }
            let positions: Vec<_> = used.iter().map(|&v| gltf_position(mesh.vertices[v])).collect();
            let normals: Vec<_> =
                used.iter().map(|&v| gltf_direction(if face == WALL { smooth[v] } else { flat })).collect();
            let displacement: Vec<f32> =
                used.iter().map(|&v| r.surface.displacement_mm.get(v).map_or(0.0, |&d| d as f32)).collect();
            let attributes = b.attributes(vec![
                (mesh::Semantic::Positions, Attribute::Triples(&positions)),
                (mesh::Semantic::Normals, Attribute::Triples(&normals)),
                (mesh::Semantic::Extras("DISPLACEMENT_MM".to_owned()), Attribute::Scalars(&displacement)),
            ]);
            let name = match r.surface.quality.caps.iter().find(|c: &&CapFacts| c.face_id == face) {
                Some(c) => c.name.clone(),
                None if face == WALL => "wall".to_owned(),
                None => format!("cap_{face}"),
            };
            mesh::Primitive {
                attributes,
                extensions: None,
                extras: extras(&json!({"face_id": face, "name": name})),
                indices: Some(b.indices(&indices)),
                material: Some(if face == WALL { wall } else { cap }),
                mode: Checked::Valid(mesh::Mode::Triangles),
                targets: None,
            }
        })
        .collect()
}

fn medial_lines(b: &mut Builder, r: &Reconstruction<'_>) -> Result<Vec<Index<scene::Node>>, Error> {
    let roles: Vec<Role> = (0..r.graph.edges.len()).map(|i| r.role_of_edge(i).unwrap_or(Role::Other)).collect();
    let mut materials = BTreeMap::new();
    let mut nodes = Vec::new();
    for (id, (edge, &role)) in r.graph.edges.iter().zip(&roles).enumerate() {
        if edge.points.len() < 2 {
            continue;
        }
        super::error::same_length(SURFACE_GLB, "radii of an edge", edge.points.len(), edge.radius_mm.len())?;
        let values: Vec<f64> =
            edge.points.iter().flat_map(|p| p.to_array()).chain(edge.radius_mm.iter().copied()).collect();
        super::error::all_finite(SURFACE_GLB, &format!("medial line {id}"), &values)?;
        let material = *materials.entry(role.name()).or_insert_with(|| {
            let [red, green, blue] = super::style::role_rgb(role).map(|c| linear(f32::from(c) / 255.0));
            b.material(&format!("medial_{}", role.name()), [red, green, blue, 1.0], Look::Line)
        });
        let positions: Vec<_> = edge.points.iter().map(|&p| gltf_position(p)).collect();
        let radius: Vec<f32> = edge.radius_mm.iter().map(|&x| x as f32).collect();
        let attributes = b.attributes(vec![
            (mesh::Semantic::Positions, Attribute::Triples(&positions)),
            (mesh::Semantic::Extras("RADIUS_MM".to_owned()), Attribute::Scalars(&radius)),
        ]);
        let once = roles.iter().filter(|&&x| x == role).count() == 1;
        let name = if once { role.name().to_owned() } else { format!("{}_{id}", role.name()) };
        let primitive = mesh::Primitive {
            attributes,
            extensions: None,
            extras: None,
            indices: None,
            material: Some(material),
            mode: Checked::Valid(mesh::Mode::LineStrip),
            targets: None,
        };
        let line = mesh::Mesh {
            extensions: None,
            extras: None,
            name: Some(format!("medial_line_{id}")),
            primitives: vec![primitive],
            weights: None,
        };
        let branch = r.morphometry.branches.iter().find(|x| x.id == id);
        let about = json!({
            "branch": id, "role": role.name(), "length_unit": "mm",
            "length_mm": branch.map(|x| x.length_mm), "diameter_mm": branch.and_then(|x| x.diameter_mm)
        });
        nodes.push(b.node(name, line, &about));
    }
    Ok(nodes)
}

/// sRGB to the linear colour that glTF factors are in.
fn linear(c: f32) -> f32 {
    if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}
