//! Who is graft, who is proximal, who is distal.
//!
//! The plan's points decide where it has them; the rule fills in the rest: the host is the pair of branches nearest to
//! straight, the graft is the third. Upstream is known only from the plan; without it the host's branches are called a
//! (smaller angle to the graft) and b, and a warning says what was chosen.

use crate::Error;
use crate::junction::Leg;
use crate::line::nearest;
use crate::track::Track;
use crate::types::{Role, Roles};
use space::{DVec3, P3, Place, V3, Warning};

/// A point of the plan further than this many local radii from every medial line is not in a vessel.
const FAR_RADII: f64 = 3.0;
/// Two choices of the host whose straightness differs by less than this, degrees, are not told apart by the rule.
const AMBIGUOUS_DEG: f64 = 10.0;

/// A plan's point on the graph.
#[derive(Clone, Copy, Debug)]
struct Site {
    role: Role,
    name: &'static str,
    position: DVec3,
    track: usize,
    abscissa: f64,
}

/// The plan's points, each with the branch that it lies in.
#[derive(Clone, Debug, Default)]
pub(crate) struct Sites {
    named: Vec<Site>,
    flow: Option<Site>,
}

impl Sites {
    /// # Errors
    /// [`Error::RolesFar`] for a point outside every vessel.
    pub(crate) fn locate(tracks: &[Track], roles: &Roles) -> Result<Self, Error> {
        let wanted = [
            (roles.graft, Role::Graft, "graft"),
            (roles.proximal, Role::Proximal, "proximal"),
            (roles.distal, Role::Distal, "distal"),
        ];
        let named = wanted
            .into_iter()
            .filter_map(|(point, role, name)| point.map(|p| site(tracks, p, role, name)))
            .collect::<Result<_, _>>()?;
        let flow = roles.flow_from.map(|p| site(tracks, p, Role::Proximal, "flow_from")).transpose()?;
        Ok(Self { named, flow })
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.named.is_empty()
    }

    /// The junction that the named points speak of: the nearest to all of them at which no two fall into one leg.
    /// `junctions` holds each node's position and legs.
    ///
    /// # Errors
    /// [`Error::RolesConflict`] when two roles share a leg at every junction.
    pub(crate) fn junction(&self, tracks: &[Track], junctions: &[(P3, Vec<Leg>)]) -> Result<Option<usize>, Error> {
        let mut best: Option<(f64, usize)> = None;
        let mut clash = None;
        for (j, (position, legs)) in junctions.iter().enumerate() {
            let through: Vec<Option<usize>> = self.named.iter().map(|s| leg_to(tracks, legs, s)).collect();
            let pair = (0..through.len())
                .flat_map(|i| (0..i).map(move |k| (k, i)))
                .find(|&(k, i)| through[i].is_some() && through[i] == through[k]);
            if let Some((k, i)) = pair {
                clash = clash.or(Some((self.named[k].name, self.named[i].name)));
                continue;
            }
            if through.iter().any(Option::is_none) {
                continue;
            }
            let distance = self.named.iter().map(|s| s.position.distance(position.raw())).sum();
            if best.is_none_or(|b| distance < b.0) {
                best = Some((distance, j));
            }
        }
        match (best, clash) {
            (Some((_, j)), _) => Ok(Some(j)),
            (None, Some((first, second))) => Err(Error::RolesConflict { first, second }),
            (None, None) => Ok(None),
        }
    }

    /// The role of each leg that the named points decide; `Other` elsewhere.
    fn given(&self, tracks: &[Track], legs: &[Leg]) -> Vec<Role> {
        let mut roles = vec![Role::Other; legs.len()];
        for s in &self.named {
            if let Some(leg) = leg_to(tracks, legs, s) {
                roles[leg] = s.role;
            }
        }
        roles
    }
}

fn site(tracks: &[Track], p: P3, role: Role, name: &'static str) -> Result<Site, Error> {
    let mut best: Option<(f64, f64, Site)> = None;
    for (t, track) in tracks.iter().enumerate() {
        let line: Vec<DVec3> = track.sections.iter().map(|s| s.position.raw()).collect();
        let (distance, i, fraction) = nearest(&line, p.raw());
        let (a, b) = (&track.sections[i], &track.sections[(i + 1).min(line.len() - 1)]);
        let radius = a.radius_area_mm().unwrap_or(a.radius_inscribed_mm).max(a.radius_inscribed_mm);
        if best.as_ref().is_none_or(|b| distance < b.0) {
            let abscissa = a.abscissa_mm + (b.abscissa_mm - a.abscissa_mm) * fraction;
            best = Some((distance, radius, Site { role, name, position: p.raw(), track: t, abscissa }));
        }
    }
    match best {
        Some((distance, radius, site)) if distance <= FAR_RADII * radius => Ok(site),
        Some((distance_mm, radius_mm, _)) => Err(Error::RolesFar { role: name, distance_mm, radius_mm, position: p }),
        None => Err(Error::RolesFar { role: name, distance_mm: f64::INFINITY, radius_mm: 0.0, position: p }),
    }
}

/// The leg through which the shortest way along the graph leads from a junction to a site.
fn leg_to(tracks: &[Track], legs: &[Leg], site: &Site) -> Option<usize> {
    let mut best: Option<(f64, usize)> = None;
    for (number, leg) in legs.iter().enumerate() {
        let Some(way) = way(tracks, legs, *leg, site) else { continue };
        if best.is_none_or(|b| way < b.0) {
            best = Some((way, number));
        }
    }
    best.map(|b| b.1)
}

/// Length of the way from a junction out through one of its legs to a site, not back through the junction.
fn way(tracks: &[Track], legs: &[Leg], leg: Leg, site: &Site) -> Option<f64> {
    let track = &tracks[leg.track];
    let (near, far) = if leg.reversed { (track.to_node, track.from_node) } else { (track.from_node, track.to_node) };
    if site.track == leg.track {
        return Some(if leg.reversed { track.length() - site.abscissa } else { site.abscissa });
    }
    let banned = |t: usize| legs.iter().any(|l| l.track == t);
    let nodes = tracks.iter().map(|t| t.from_node.max(t.to_node)).max()? + 1;
    let mut reached = vec![f64::INFINITY; nodes];
    if far != near {
        reached[far] = track.length();
    }
    // Bellman and Ford; the graphs have tens of edges
    for _ in 0..nodes {
        for (_, edge) in tracks.iter().enumerate().filter(|&(t, _)| !banned(t)) {
            let length = edge.length();
            reached[edge.to_node] = reached[edge.to_node].min(reached[edge.from_node] + length);
            reached[edge.from_node] = reached[edge.from_node].min(reached[edge.to_node] + length);
        }
    }
    if banned(site.track) {
        return None;
    }
    let edge = &tracks[site.track];
    let way = (reached[edge.from_node] + site.abscissa).min(reached[edge.to_node] + edge.length() - site.abscissa);
    way.is_finite().then_some(way)
}

/// Angle between two legs, degrees; 0 where a direction is unknown.
fn angle(directions: &[Option<V3>], a: usize, b: usize) -> f64 {
    match (directions[a], directions[b]) {
        (Some(a), Some(b)) => a.angle_to(b).to_degrees(),
        _ => 0.0,
    }
}

/// The roles of a junction's legs. With more than three legs only
/// what the points say is taken.
pub(crate) fn assign(
    tracks: &[Track],
    legs: &[Leg],
    directions: &[Option<V3>],
    sites: &Sites,
    scope: Scope,
    warnings: &mut Vec<Warning>,
) -> Vec<Role> {
    let mut roles = if scope.main { sites.given(tracks, legs) } else { vec![Role::Other; legs.len()] };
    if legs.len() != 3 {
        return roles;
    }
    let Scope { node, position, .. } = scope;
    let place = Place { element: Some(node), position: Some(position), ..Place::none() };
    let graft = choose_graft(tracks, legs, directions, &roles, &place, warnings);
    roles[graft] = Role::Graft;
    let host: Vec<usize> = (0..3).filter(|&i| i != graft).collect();
    let known = |role: Role| host.iter().position(|&i| roles[i] == role);
    let upstream = known(Role::Proximal).or_else(|| known(Role::Distal).map(|i| 1 - i)).or_else(|| {
        sites.flow.as_ref().and_then(|s| leg_to(tracks, legs, s)).and_then(|l| host.iter().position(|&i| i == l))
    });
    if let Some(i) = upstream {
        (roles[host[i]], roles[host[1 - i]]) = (Role::Proximal, Role::Distal);
    } else {
        let first = usize::from(angle(directions, graft, host[1]) < angle(directions, graft, host[0]));
        (roles[host[first]], roles[host[1 - first]]) = (Role::HostA, Role::HostB);
        let message = format!(
            "the flow direction at junction {node} is not given: host_a is branch {}, on the side of the smaller angle to the graft, host_b is branch {}; give roles.flow_from_mm or roles.proximal_mm to name them",
            tracks[legs[host[first]].track].id,
            tracks[legs[host[1 - first]].track].id,
        );
        warnings.push(Warning::new("roles.flow_unknown", message, place));
    }
    roles
}

/// A junction, and whether the plan's named points speak of it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scope {
    pub(crate) node: usize,
    pub(crate) position: P3,
    pub(crate) main: bool,
}

fn choose_graft(
    tracks: &[Track],
    legs: &[Leg],
    directions: &[Option<V3>],
    roles: &[Role],
    place: &Place,
    warnings: &mut Vec<Warning>,
) -> usize {
    if let Some(graft) = roles.iter().position(|&r| r == Role::Graft) {
        return graft;
    }
    let in_host = |i: usize| roles[i] != Role::Other;
    // the graft is a leg without a role; its host is the other two
    let mut choices: Vec<(f64, usize)> =
        (0..3).filter(|&g| !in_host(g)).map(|g| (angle(directions, (g + 1) % 3, (g + 2) % 3), g)).collect();
    choices.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let Some(&(straight, graft)) = choices.first() else { return 0 };
    if let Some(&(next, _)) = choices.get(1) {
        let id = tracks[legs[graft].track].id;
        let message = format!(
            "roles by rule: branch {id} is the graft, because the other two are nearest to straight ({straight:.1} degrees; the next pair {next:.1})"
        );
        warnings.push(Warning::new("roles.by_rule", message, place.clone()));
        if straight - next < AMBIGUOUS_DEG {
            let message = format!(
                "the rule hardly tells host from graft here ({straight:.1} against {next:.1} degrees); give roles.graft_mm"
            );
            warnings.push(Warning::new("roles.ambiguous", message, place.clone()));
        }
    }
    graft
}
