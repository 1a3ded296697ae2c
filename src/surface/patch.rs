//! Patches without drawing: which branch a wall face belongs to, and where on the branch it lies.
//!
//! For every cap the harmonic function that is 1 on its rim and 0 on the other rims (method 7); a face belongs to the
//! cap whose function is largest. In a bifurcation the three regions meet at two poles and each is an annulus. Within a
//! region u is harmonic, 0 on the separating curve and 1 on the rim; v is its conjugate: the harmonic function that
//! grows by 1 once around, with the natural condition at both ends, so lines of equal u and v cross at right angles.
//!
//! Limits: separating curves follow mesh edges (they are not embedded); v is given on regions that are annuli, others
//! (a branch that ends blind and is large, a loop) say so.

use crate::sparse::harmonic;
use crate::web::{Web, next, prev};
use crate::{Error, TriMesh, WALL};
use exec::Ctx;
use std::collections::VecDeque;

/// Patch of every face, coordinates on it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Patches {
    /// Per face. Wall faces carry the id given for their branch's cap; the cap with face id k carries `caps[k - 1]`.
    /// A surface with no or one cap has one wall patch.
    pub patch_id: Vec<u32>,
    /// Patch id of each cap, by face id: numbered on from the largest wall patch.
    pub caps: Vec<u32>,
    /// Per vertex, 0 on the separating curves to 1 on the rim. Single-valued. 0 where there is no u.
    pub u: Vec<f64>,
    /// Per vertex, in [0, 1), around the branch. Periodic: neighbours may read .98 and .01, and a vertex on a separating
    /// curve carries the value of its patch with the lowest id. Use [`Patches::uv`] where faces are drawn or refined.
    pub v: Vec<f64>,
    /// Per face and corner, u and v without the seam: v is continuous within the face and may exceed 1.
    pub uv: Vec<[[f64; 2]; 3]>,
    /// Wall patches (ids) that are not annuli: v is 0 there.
    pub without_v: Vec<u32>,
    /// Whether u and v mean anything: at least two caps.
    pub has_coordinates: bool,
}

/// Divide the wall into one patch per cap and give coordinates on each.
///
/// `ids` holds a patch id per cap, in the order of face ids (the branch numbers of the medial graph). Works for a tube
/// (two caps: each takes its half), a bifurcation, a trifurcation; with one or no cap the wall is one patch, id 0 or the
/// cap's, without coordinates.
///
/// # Errors
/// [`Error::PatchIds`], [`Error::Defect`], [`Error::PatchSolve`], [`Error::Cancelled`].
pub fn patches(mesh: &TriMesh, ids: &[u32], ctx: &Ctx) -> Result<Patches, Error> {
    let caps = mesh.face_id.iter().copied().max().unwrap_or(WALL) as usize;
    if ids.len() != caps {
        return Err(Error::PatchIds { ids: ids.len(), caps });
    }
    let web = Web::weave(mesh)?;
    let first_cap = ids.iter().copied().max().unwrap_or(0) + 1;
    let mut out = Patches {
        caps: (0..caps as u32).map(|k| first_cap + k).collect(),
        u: vec![0.0; mesh.vertices.len()],
        v: vec![0.0; mesh.vertices.len()],
        uv: vec![[[0.0; 2]; 3]; mesh.triangles.len()],
        has_coordinates: caps >= 2,
        ..Patches::default()
    };
    let label = if caps >= 2 { labels(mesh, &web, caps, ctx)? } else { vec![0; mesh.triangles.len()] };
    out.patch_id = (mesh.face_id.iter().zip(&label))
        .map(|(&id, &l)| match id {
            WALL => ids.get(l).copied().unwrap_or(0),
            k => out.caps[k as usize - 1],
        })
        .collect();
    if caps >= 2 {
        // Ascending ids last to first, so that the lowest id has the last word on shared vertices.
        let mut order: Vec<usize> = (0..caps).collect();
        order.sort_by_key(|&l| std::cmp::Reverse(ids[l]));
        for l in order {
            let region = Region::new(mesh, &web, &label, l);
            region.coordinates(ids[l], &mut out, ctx)?;
        }
    }
    ctx.progress(1.0);
    Ok(out)
}

/// The cap (face id - 1) of each rim vertex.
fn rims(mesh: &TriMesh) -> Vec<Option<usize>> {
    let mut rim = vec![None; mesh.vertices.len()];
    for (tri, &id) in mesh.triangles.iter().zip(&mesh.face_id).filter(|(_, id)| **id != WALL) {
        tri.iter().for_each(|&v| rim[v as usize] = Some(id as usize - 1));
    }
    rim
}

/// For every wall face the cap that it belongs to: the largest harmonic function, then grown from the rims so that each
/// label is one region.
fn labels(mesh: &TriMesh, web: &Web, caps: usize, ctx: &Ctx) -> Result<Vec<usize>, Error> {
    let rim = rims(mesh);
    let wall: Vec<usize> = (0..mesh.triangles.len()).filter(|&t| mesh.face_id[t] == WALL).collect();
    // The functions sum to 1: the last needs no solving.
    let mut h = ctx
        .map_range(caps - 1, |k| {
            let given: Vec<Option<f64>> = rim.iter().map(|r| r.map(|r| f64::from(u8::from(r == k)))).collect();
            harmonic(mesh, &wall, &given, |_, _| 0.0, ctx)
        })?
        .into_iter()
        .collect::<Result<Vec<_>, _>>()?;
    h.push((0..mesh.vertices.len()).map(|v| h.iter().fold(1.0, |s, h| s - h[v])).collect());
    let sum = |k: usize, t: usize| mesh.triangles[t].iter().fold(0.0, |s, &v| s + h[k][v as usize]);
    let mut largest = vec![usize::MAX; mesh.triangles.len()];
    for &t in &wall {
        largest[t] = (0..caps).fold(0, |best, k| if sum(k, t) > sum(best, t) { k } else { best });
    }
    Ok(grown(mesh, web, &largest, &rim))
}

/// Keep what hangs together with the label's own rim; the rest takes the label of its neighbours, breadth first.
fn grown(mesh: &TriMesh, web: &Web, largest: &[usize], rim: &[Option<usize>]) -> Vec<usize> {
    let mut label = vec![usize::MAX; largest.len()];
    let mut open = VecDeque::new();
    for t in 0..largest.len() {
        let own = mesh.triangles[t].iter().any(|&v| rim[v as usize] == Some(largest[t]));
        if mesh.face_id[t] == WALL && own {
            label[t] = largest[t];
            open.push_back(t);
        }
    }
    let mut later = VecDeque::new();
    while let Some(t) = open.pop_front().or_else(|| later.pop_front()) {
        for h in 3 * t..3 * t + 3 {
            let o = web.twin[h] as usize / 3;
            if mesh.face_id[o] != WALL || label[o] != usize::MAX {
                continue;
            }
            if largest[o] == label[t] {
                label[o] = label[t];
                open.push_back(o);
            } else if later.back() != Some(&t) {
                later.push_back(t);
            }
        }
        if open.is_empty() && !later.is_empty() {
            // Only strays are left: they join whichever neighbour comes first.
            while let Some(s) = later.pop_front() {
                for h in 3 * s..3 * s + 3 {
                    let o = web.twin[h] as usize / 3;
                    if mesh.face_id[o] == WALL && label[o] == usize::MAX {
                        label[o] = label[s];
                        later.push_back(o);
                    }
                }
            }
        }
    }
    label
}

/// One wall patch.
struct Region<'a> {
    mesh: &'a TriMesh,
    web: &'a Web,
    inside: Vec<bool>,
    triangles: Vec<usize>,
    /// Per vertex: on the rim of the patch's cap (1), on another edge of the patch (0), elsewhere.
    end: Vec<Option<f64>>,
}

impl<'a> Region<'a> {
    fn new(mesh: &'a TriMesh, web: &'a Web, label: &[usize], l: usize) -> Self {
        let inside: Vec<bool> = (0..label.len()).map(|t| mesh.face_id[t] == WALL && label[t] == l).collect();
        let triangles: Vec<usize> = (0..inside.len()).filter(|&t| inside[t]).collect();
        let mut end = vec![None; mesh.vertices.len()];
        for pass in [0.0, 1.0] {
            for h in triangles.iter().flat_map(|&t| 3 * t as u32..3 * t as u32 + 3) {
                let across = web.twin[h as usize] as usize / 3;
                let own_rim = mesh.face_id[across] == l as u32 + 1;
                if !inside[across] && own_rim == (pass > 0.5) {
                    end[web.origin[h as usize] as usize] = Some(pass);
                    end[web.target(h) as usize] = Some(pass);
                }
            }
        }
        Self { mesh, web, inside, triangles, end }
    }

    fn coordinates(&self, id: u32, out: &mut Patches, ctx: &Ctx) -> Result<(), Error> {
        let u = harmonic(self.mesh, &self.triangles, &self.end, |_, _| 0.0, ctx)?;
        let v = if self.is_annulus() { self.seam() } else { None };
        let Some(seam) = v else {
            out.without_v.push(id);
            self.write(&u, None, out);
            return Ok(());
        };
        let mut given = vec![None; self.mesh.vertices.len()];
        given[seam.from as usize] = Some(0.0);
        let v = harmonic(self.mesh, &self.triangles, &given, |t, k| seam.jump[t][k], ctx)?;
        self.write(&u, Some((&v, &seam)), out);
        Ok(())
    }

    fn write(&self, u: &[f64], v: Option<(&[f64], &Seam)>, out: &mut Patches) {
        for &t in &self.triangles {
            for (k, &i) in self.mesh.triangles[t].iter().enumerate() {
                let i = i as usize;
                out.u[i] = u[i].clamp(0.0, 1.0);
                let around = v.map_or(0.0, |(v, seam)| v[i] + seam.jump[t][k]);
                out.v[i] = v.map_or(0.0, |(v, _)| v[i].rem_euclid(1.0));
                out.uv[t][k] = [out.u[i], around];
            }
        }
    }

    /// Euler number 0 and both ends present.
    fn is_annulus(&self) -> bool {
        let mut seen = vec![false; self.mesh.vertices.len()];
        let (mut inner, mut border) = (0_usize, 0_usize);
        for h in self.triangles.iter().flat_map(|&t| 3 * t..3 * t + 3) {
            seen[self.web.origin[h] as usize] = true;
            let twice = self.inside[self.web.twin[h] as usize / 3];
            inner += usize::from(twice);
            border += usize::from(!twice);
        }
        let vertices = seen.iter().filter(|&&s| s).count();
        let both = self.end.contains(&Some(0.0)) && self.end.contains(&Some(1.0));
        both && vertices + self.triangles.len() == inner / 2 + border
    }

    /// A shortest path (in edges) from the rim to the other end, and the corners on its left.
    fn seam(&self) -> Option<Seam> {
        let path = self.path()?;
        let mut jump = vec![[0.0; 3]; self.mesh.triangles.len()];
        let mark = |jump: &mut Vec<[f64; 3]>, h: u32| jump[h as usize / 3][h as usize % 3] = 1.0;
        // Left of the path: counterclockwise from each step until the step before it or the patch's edge.
        for (i, &h) in path.iter().enumerate() {
            let back = if i > 0 { Some(self.web.twin[path[i - 1] as usize]) } else { None };
            let mut s = h;
            while self.inside[s as usize / 3] {
                mark(&mut jump, s);
                s = self.web.twin[prev(s) as usize];
                if Some(s) == back || s == h {
                    break;
                }
            }
        }
        // At the last vertex: clockwise from the last step, seen from its end.
        let mut s = next(*path.last()?);
        while self.inside[s as usize / 3] {
            mark(&mut jump, s);
            s = next(self.web.twin[s as usize]);
            if s == next(*path.last()?) {
                break;
            }
        }
        Some(Seam { from: self.web.origin[path[0] as usize], jump })
    }

    fn path(&self) -> Option<Vec<u32>> {
        let first = (0..self.end.len() as u32).find(|&v| self.end[v as usize] == Some(1.0))?;
        let mut came = vec![u32::MAX; self.end.len()];
        let mut open = VecDeque::from([first]);
        while let Some(v) = open.pop_front() {
            if self.end[v as usize] == Some(0.0) {
                let (mut path, mut at) = (Vec::new(), v);
                while at != first {
                    path.push(came[at as usize]);
                    at = self.web.origin[came[at as usize] as usize];
                }
                path.reverse();
                return Some(path);
            }
            for h in self.web.spokes(v) {
                let o = self.web.target(h);
                // Through the patch's inside only, and off the rim at once.
                let through = self.inside[h as usize / 3] && self.inside[self.web.twin[h as usize] as usize / 3];
                if through && self.end[o as usize] != Some(1.0) && came[o as usize] == u32::MAX {
                    came[o as usize] = h;
                    open.push_back(o);
                }
            }
        }
        None
    }
}

/// Where v jumps by 1.
struct Seam {
    /// The rim vertex at which it starts; v is 0 there.
    from: u32,
    /// Per face and corner: 1 for corners on the seam whose face lies on its left.
    jump: Vec<[f64; 3]>,
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::{PolygoniseSettings, RemeshSettings, Sizing, cut, fields, polygonise, remesh};
    use imaging::CutPlane;
    use space::{P3, V3};

    fn meshed(field: &fields::Analytic, cuts: &[CutPlane], ctx: &Ctx) -> (TriMesh, usize) {
        // The way of the pipeline: closed a little outside the planes, cut raw, landed by the remeshing.
        let bounded = crate::Bounded::new(field, cuts, 2.0);
        let seed = [P3::new(-3.0, 0.0, 12.0)];
        let (raw, _) = polygonise(&bounded, &seed, &PolygoniseSettings::default(), ctx).unwrap();
        let (mesh, report) = cut(&raw, field, cuts, ctx).unwrap();
        let s = RemeshSettings { sizing: Sizing::Uniform(0.6), ..RemeshSettings::default() };
        (remesh(&mesh, field, cuts, &s, ctx).unwrap().0, report.caps.len())
    }

    fn ends() -> [CutPlane; 2] {
        [CutPlane::new(P3::new(0.0, 0.0, 15.03), V3::Z), CutPlane::new(P3::new(0.0, 0.0, -15.0), -V3::Z)]
    }

    /// Every face must run the same way through (u, v): no fold, and v must span one turn.
    fn sound(p: &Patches, mesh: &TriMesh) {
        assert_eq!(p.without_v, Vec::<u32>::new());
        let area = |t: usize| {
            let [a, b, c] = p.uv[t];
            (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        };
        let wall: Vec<usize> = (0..mesh.triangles.len()).filter(|&t| mesh.face_id[t] == WALL).collect();
        let mut ids = p.patch_id.iter().zip(&mesh.face_id).filter(|x| *x.1 == WALL).map(|x| *x.0).collect::<Vec<_>>();
        ids.sort_unstable();
        ids.dedup();
        for id in ids {
            let faces = wall.iter().filter(|&&t| p.patch_id[t] == id);
            let (sum, bad) = faces.clone().fold((0.0, 0), |(s, n), &t| (s + area(t), n + usize::from(area(t) >= 0.0)));
            let n = faces.count();
            // The unrolled annulus covers the unit square once.
            assert!((sum.abs() / 2.0 - 1.0).abs() < 0.02, "patch {id}: area {sum}");
            assert!(bad.min(n - bad) * 100 <= n, "patch {id}: {bad} of {n} faces folded");
        }
    }

    #[test]
    fn a_tube_has_straight_coordinates() {
        let ctx = Ctx::new(2).unwrap();
        let field = fields::tree(vec![(V3::Z, 24.0, 3.0), (-V3::Z, 24.0, 3.0)], vec![1e-6]);
        let (mesh, caps) = meshed(&field, &ends(), &ctx);
        assert_eq!(caps, 2);
        let p = patches(&mesh, &[4, 7], &ctx).unwrap();
        sound(&p, &mesh);
    }

    #[test]
    fn a_bifurcation_has_three_annuli() {
        let ctx = Ctx::new(2).unwrap();
        let (mesh, caps) = meshed(&fields::anastomosis(), &ends(), &ctx);
        assert_eq!(caps, 3);
        sound(&patches(&mesh, &[0, 1, 2], &ctx).unwrap(), &mesh);
    }

    #[test]
    fn a_trifurcation_has_four_patches() {
        let ctx = Ctx::new(2).unwrap();
        let branches = [(V3::Z, 3.0), (-V3::Z, 3.0), (V3::new(0.8, 0.0, 0.6), 2.5), (V3::new(-0.6, 0.0, 0.8), 2.5)];
        let field = fields::tree(branches.map(|(d, r)| (d, 24.0, r)).to_vec(), vec![1.5, 1.5, 1.5]);
        // The side first: its branch's tip, which the upper plane would graze, is gone by then.
        let mut cuts = vec![CutPlane::new(P3::new(15.0, 0.0, 0.0), V3::X)];
        cuts.extend(ends());
        let (mesh, caps) = meshed(&field, &cuts, &ctx);
        assert_eq!(caps, 4);
        let p = patches(&mesh, &[3, 1, 2, 0], &ctx).unwrap();
        // One of the four regions borders two others on separate curves: no annulus, and it says so.
        assert_eq!(p.without_v, vec![0]);
        assert!((0..4).all(|id| p.patch_id.contains(&id)));
    }

    #[test]
    fn a_closed_surface_is_one_patch() {
        let ctx = Ctx::new(1).unwrap();
        let field = fields::torus(6.0, 2.0);
        let (mesh, _) = polygonise(&field, &[P3::new(8.0, 0.0, 0.0)], &PolygoniseSettings::default(), &ctx).unwrap();
        let p = patches(&mesh, &[], &ctx).unwrap();
        assert!(!p.has_coordinates && p.patch_id.iter().all(|&id| id == 0));
    }
}
