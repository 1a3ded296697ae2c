//! The whole of the morphometry: sections, junctions, roles, angles, helix, in this order.

use crate::Error;
use crate::angle::{Between, Undefined, named, plane_normal, triple};
use crate::bands::{Varied, band95};
use crate::fit::FittedLine;
use crate::helix::fitted;
use crate::junction::{
    Axes, FROM_CROTCH, Leg, LegPoint, Ruler, WINDOW_MIN, axes, chord, fit_window, flag, leg_line, leg_radius, legs_at,
};
use crate::linear::median;
use crate::path;
use crate::roles::{Scope, Sites, assign};
use crate::section::Lumen;
use crate::track::{Track, curvature, finish, tracks};
use crate::types::{Angle, Branch, ByDistance, Junction, Morphometry, Role, Settings, Stenosis, VmtkAngles};
use crate::vmtk::{Ball, vmtk_angles};
use exec::Ctx;
use imaging::CutPlane;
use implicit::{Draws, Field};
use skeleton::MedialGraph;
use space::{P3, Place, V3, Warning};

/// Grid of `by_distance`, graft diameters.
const GRID_DIAMETERS: f64 = 0.1;
/// Longest distance of `by_distance`, graft diameters.
const GRID_END_DIAMETERS: f64 = 12.0;
/// Largest window end that a plan may ask for, graft diameters.
const WINDOW_LIMIT_DIAMETERS: f64 = 100.0;

/// Measures every branch and junction of a medial graph against the implicit function.
///
/// Branches are numbered as the graph's edges; a leaf branch runs from its junction outward. Sections follow the line at
/// an eighth of the median radius, at most .5 mm. `cuts` are the planes at which the data end. The result does not
/// depend on the order of nodes, edges or points (to 1e-9), and not at all on the number of threads.
///
/// # Errors
/// [`Error::Cancelled`]; [`Error::Graph`] for an edge that is no line; [`Error::RolesFar`], [`Error::RolesConflict`] and
/// [`Error::Window`] when the plan is at fault. An angle that cannot be had is `None` with a warning, not an error.
///
/// Cost: about 1200 evaluations of f per section.
pub fn measure(
    graph: &MedialGraph,
    field: &dyn Field,
    cuts: &[CutPlane],
    settings: &Settings,
    ctx: &Ctx,
) -> Result<Morphometry, Error> {
    measure_with_bands(graph, field, cuts, None, settings, ctx)
}

/// [`measure`], with 95 % bands of angles, diameters, curvatures and torsions and standard errors of areas from `draws` of
/// other functions that the data allow; without them no bands.
///
/// # Errors
/// As [`measure`].
///
/// Cost: 24 differences of a draw from the fitted function per section and draw.
pub fn measure_with_bands(
    graph: &MedialGraph,
    field: &dyn Field,
    cuts: &[CutPlane],
    draws: Option<&dyn Draws>,
    settings: &Settings,
    ctx: &Ctx,
) -> Result<Morphometry, Error> {
    check_window(settings)?;
    let lumen = Lumen { field, cuts };
    let mut warnings = Vec::new();
    let mut tracks = tracks(graph, lumen, &ctx.part(0.0, 0.4))?;
    ctx.progress(0.4);
    let places = places(graph, &tracks);
    let own = Ruler::Own { to: settings.fit_to_diameters };
    let rough = solve_junctions(&tracks, &places, field, |_| own, ctx)?;
    flag_all(&mut tracks, &places, &rough);
    finish(&mut tracks, lumen, ctx)?;
    ctx.progress(0.8);
    flag_all(&mut tracks, &places, &rough);

    let sites = Sites::locate(&tracks, &settings.roles)?;
    let main = main_junction(&tracks, &places, &sites, &mut warnings)?;
    let mut roles = Vec::new();
    for (j, place) in places.iter().enumerate() {
        let scope = Scope { node: place.node, position: place.position, main: main == Some(j) };
        let directions = rough_directions(&tracks, place, &rough[j]);
        roles.push(assign(&tracks, &place.legs, &directions, &sites, scope, &mut warnings));
    }
    let diameters: Vec<f64> = places.iter().zip(&roles).map(|(p, r)| graft_diameter(&tracks, p, r)).collect();
    let ruler = |j: usize| Ruler::Shared {
        diameter: diameters[j],
        from: settings.fit_from_diameters.unwrap_or(0.0),
        to: settings.fit_to_diameters,
    };
    let mut fitted = solve_junctions(&tracks, &places, field, ruler, ctx)?;
    for turn in 0..=SETTLING_TURNS {
        tracks.iter_mut().for_each(Track::reset_junction);
        flag_all(&mut tracks, &places, &fitted);
        if turn < SETTLING_TURNS {
            fitted = solve_junctions(&tracks, &places, field, ruler, ctx)?;
        }
    }
    curvature(&mut tracks, ctx)?;
    ctx.progress(0.9);
    let varied = match draws.filter(|d| d.count() > 0) {
        Some(draws) => Some(Varied::new(&tracks, lumen, draws, &ctx.part(0.9, 1.0))?),
        None => None,
    };
    if let Some(varied) = &varied {
        varied.section_errors(&mut tracks);
    }

    let mut junctions = Vec::new();
    for (j, place) in places.iter().enumerate() {
        ctx.check()?;
        let site = Site {
            tracks: &tracks,
            place,
            axes: &fitted[j],
            roles: &roles[j],
            diameter: diameters[j],
            varied: varied.as_ref(),
            lumen,
        };
        junctions.push(site.junction(settings, &mut warnings));
    }
    let known = Known { places: &places, roles: &roles, fitted: &fitted, main };
    let branches = ctx.map_range(tracks.len(), |t| branch(&tracks, t, &known, varied.as_ref()))?;
    warn_sections(&tracks, &mut warnings);
    ctx.progress(1.0);
    Ok(Morphometry { branches, junctions, warnings })
}

/// Times that the junctions are solved again with each other's overlaps as they are known by then: the first, from rough
/// directions, may claim a whole branch between two junctions for itself. A vessel with one junction does not change.
const SETTLING_TURNS: usize = 3;

fn check_window(settings: &Settings) -> Result<(), Error> {
    let to = settings.fit_to_diameters;
    if !(to > 0.0 && to <= WINDOW_LIMIT_DIAMETERS) {
        return Err(Error::Window { field: "fit_to_diameters", value: to });
    }
    match settings.fit_from_diameters {
        Some(from) if !(from >= 0.0 && from < to) => Err(Error::Window { field: "fit_from_diameters", value: from }),
        _ => Ok(()),
    }
}

/// A node at which three or more legs meet.
struct Spot {
    node: usize,
    position: P3,
    radius: f64,
    legs: Vec<Leg>,
}

impl Spot {
    fn place(&self) -> Place {
        Place { element: Some(self.node), position: Some(self.position), ..Place::none() }
    }
}

fn places(graph: &MedialGraph, tracks: &[Track]) -> Vec<Spot> {
    let spot = |(node, n): (usize, &skeleton::Node)| Spot {
        node,
        position: n.position,
        radius: n.radius_mm,
        legs: legs_at(tracks, node),
    };
    graph.nodes.iter().enumerate().map(spot).filter(|s| s.legs.len() >= 3).collect()
}

fn solve_junctions(
    tracks: &[Track],
    places: &[Spot],
    field: &dyn Field,
    ruler: impl Fn(usize) -> Ruler + Sync,
    ctx: &Ctx,
) -> Result<Vec<Axes>, Error> {
    Ok(ctx.map_range(places.len(), |j| {
        let p = &places[j];
        axes(tracks, &p.legs, field, p.position, p.radius, ruler(j))
    })?)
}

fn flag_all(tracks: &mut [Track], places: &[Spot], axes: &[Axes]) {
    for (p, a) in places.iter().zip(axes) {
        flag(tracks, &p.legs, a);
    }
}

fn main_junction(
    tracks: &[Track],
    places: &[Spot],
    sites: &Sites,
    warnings: &mut Vec<Warning>,
) -> Result<Option<usize>, Error> {
    if sites.is_empty() {
        return Ok(None);
    }
    let at: Vec<(P3, Vec<Leg>)> = places.iter().map(|p| (p.position, p.legs.clone())).collect();
    let main = sites.junction(tracks, &at)?;
    if main.is_none() {
        let message = "no junction connects the branches in which the roles' points lie; the roles were not used";
        warnings.push(Warning::new("roles.no_junction", message, Place::field("roles")));
    }
    Ok(main)
}

/// Fitted directions, chords where there is no fit.
fn rough_directions(tracks: &[Track], place: &Spot, axes: &Axes) -> Vec<Option<V3>> {
    place
        .legs
        .iter()
        .enumerate()
        .map(|(i, &leg)| {
            axes.direction(i).or_else(|| {
                let track = &tracks[leg.track];
                let samples = axes.samples(tracks, leg);
                chord(&samples, axes.origin, leg_radius(track, leg, place.radius))
            })
        })
        .collect()
}

/// What all spans have in common; where one ends before another begins (each leg's window starts at its own crotch), the
/// stretch that they lie in together.
fn common_window(spans: &[[f64; 2]]) -> [f64; 2] {
    let (starts, ends) = (spans.iter().map(|s| s[0]), spans.iter().map(|s| s[1]));
    let common = [starts.clone().fold(0.0, f64::max), ends.clone().fold(f64::INFINITY, f64::min)];
    if common[0] < common[1] {
        return common;
    }
    [starts.fold(f64::INFINITY, f64::min), ends.fold(0.0, f64::max)]
}

/// Diameter of the graft, mm; of the median branch where no leg is the graft.
fn graft_diameter(tracks: &[Track], place: &Spot, roles: &[Role]) -> f64 {
    let of = |leg: &Leg| {
        let t = &tracks[leg.track];
        2.0 * t.area_radius(|_| true).unwrap_or_else(|| t.radius())
    };
    let graft = roles.iter().position(|&r| r == Role::Graft).map(|g| of(&place.legs[g]));
    graft.or_else(|| median(place.legs.iter().map(of).collect())).unwrap_or(0.0)
}

/// A junction with what is known of it.
struct Site<'a> {
    tracks: &'a [Track],
    place: &'a Spot,
    axes: &'a Axes,
    roles: &'a [Role],
    diameter: f64,
    varied: Option<&'a Varied>,
    lumen: Lumen<'a>,
}

impl Site<'_> {
    fn junction(&self, settings: &Settings, warnings: &mut Vec<Warning>) -> Junction {
        let ids: Vec<usize> = self.place.legs.iter().map(|l| self.tracks[l.track].id).collect();
        self.warn_windows(&ids, settings, warnings);
        let directions: Vec<Option<V3>> = (0..ids.len()).map(|i| self.axes.direction(i)).collect();
        let (diameters, curves) = self.curves();
        let varied = self.varied.map(|v| v.directions(&self.place.legs, self.axes));
        let mut normal_missing = None;
        let mut angles = Vec::new();
        for (name, between) in named(self.roles, &ids) {
            let value = between.value(&directions);
            if let Err(why @ (Undefined::NoPlane | Undefined::NoProjection)) = value {
                normal_missing = Some(why);
                warnings.push(self.undefined(&name, why));
            }
            let by_distance = ByDistance {
                diameters: diameters.clone(),
                value_deg: curves.iter().map(|d| between.value(&directions_of(d)).ok()).collect(),
                residual_mm: curves.iter().map(|d| residual(d, between)).collect(),
            };
            let drawn = |value: f64| {
                let values = varied.as_ref()?.iter().map(|d| between.value(d).ok());
                band95(value, values).map(|[low, high]| [low.max(0.0), high.min(180.0)])
            };
            angles.push(Angle {
                name,
                value_deg: value.ok(),
                band95_deg: value.ok().and_then(drawn),
                window_diameters: value.ok().map(|_| self.window(between)),
                by_distance: Some(by_distance),
            });
        }
        let plane = triple(self.roles).filter(|_| normal_missing != Some(Undefined::NoPlane));
        Junction {
            node: self.place.node,
            medial_point: self.place.position,
            axes_point: self.axes.point,
            plane_normal: plane.and_then(|[g, p, _]| plane_normal(directions[g]?, directions[p]?)),
            crotch_mm: Some(self.axes.crotch()),
            branches: ids,
            angles,
            vmtk: self.vmtk(),
        }
    }

    fn vmtk(&self) -> Option<VmtkAngles> {
        let radius = |leg: &Leg| self.tracks[leg.track].own_radius();
        let widest = || {
            let legs = self.place.legs.iter().enumerate();
            legs.max_by(|a, b| radius(a.1).total_cmp(&radius(b.1)).then(b.0.cmp(&a.0))).map(|(l, _)| l)
        };
        let inlet = self.roles.iter().position(|&r| r == Role::Proximal).or_else(widest)?;
        let ball = |p: LegPoint| Ball { centre: p.point, radius: p.radius };
        let line = |&leg: &Leg| leg_line(self.tracks, leg).into_iter().map(ball).collect();
        let lines: Vec<Vec<Ball>> = self.place.legs.iter().map(line).collect();
        let size = radius(&self.place.legs[inlet]);
        let (centre, wall) = (self.place.position.raw(), path::wall(&lines, self.lumen, size));
        let led = |line| path::least(line, centre, self.lumen, &wall, size);
        vmtk_angles(&lines, inlet, self.tracks[self.place.legs[inlet].track].id, led)
    }

    /// The window that all legs of an angle have data in, graft diameters.
    fn window(&self, between: Between) -> [f64; 2] {
        let spans: Vec<[f64; 2]> = between
            .legs()
            .iter()
            .map(|&l| &self.axes.windows[l])
            .map(|(window, fit)| [window[0] / self.diameter, fit.to / self.diameter])
            .collect();
        common_window(&spans)
    }

    /// Lines of all legs for windows that end at each distance of the grid.
    fn curves(&self) -> (Vec<f64>, Vec<Vec<Option<FittedLine>>>) {
        let from = self.axes.windows.iter().map(|w| w.0[0]).fold(0.0, f64::max);
        let samples: Vec<_> = self.place.legs.iter().map(|&l| self.axes.samples(self.tracks, l)).collect();
        let end = |leg: usize| {
            samples[leg].iter().filter(|s| s.usable).map(|s| s.distance).fold(0.0, f64::max) / self.diameter
        };
        let ends: Vec<f64> = (0..samples.len()).map(end).collect();
        let last = ends.iter().copied().fold(0.0, f64::max).min(GRID_END_DIAMETERS);
        let mut step = ((from / self.diameter + WINDOW_MIN) / GRID_DIAMETERS).ceil();
        let (mut grid, mut directions) = (Vec::new(), Vec::new());
        while step * GRID_DIAMETERS <= last {
            let d = step / GRID_DIAMETERS.recip();
            grid.push(d);
            directions.push(
                samples
                    .iter()
                    .zip(&self.axes.windows)
                    .zip(&ends)
                    .map(|((s, (window, _)), &end)| {
                        let fit = fit_window(s, window[0], d * self.diameter, WINDOW_MIN * self.diameter);
                        fit.line.filter(|_| d <= end + GRID_DIAMETERS)
                    })
                    .collect(),
            );
            step += 1.0;
        }
        (grid, directions)
    }

    fn undefined(&self, name: &str, why: Undefined) -> Warning {
        let node = self.place.node;
        match why {
            Undefined::NoProjection => Warning::new(
                "angles.projection_undefined",
                format!(
                    "{name} at junction {node} has no value: the vessel stands upright on the plane (within 5 degrees)"
                ),
                self.place.place(),
            ),
            Undefined::NoPlane | Undefined::NoLine => Warning::new(
                "angles.plane_undefined",
                format!(
                    "{name} at junction {node} has no value: graft and proximal vessel lie within 5 degrees of one line and span no plane"
                ),
                self.place.place(),
            ),
        }
    }

    fn warn_windows(&self, ids: &[usize], settings: &Settings, warnings: &mut Vec<Warning>) {
        let (node, d) = (self.place.node, self.diameter);
        let mut warn = |code, message| warnings.push(Warning::new(code, message, self.place.place()));
        if self.axes.point.is_none() {
            warn(
                "angles.axes_parallel",
                format!(
                    "the lines of the branches at junction {node} do not meet in it; distances are measured from the medial point"
                ),
            );
        }
        if !self.axes.settled {
            warn(
                "angles.unsettled",
                format!(
                    "windows and axes at junction {node} did not settle; look at the angles' dependence on distance"
                ),
            );
        }
        if self.axes.moved {
            let message = format!(
                "the lumens at junction {node} overlap up to {:.1} mm; the fit window, asked to end at {:.1} graft diameters, was moved out",
                self.axes.crotch(),
                settings.fit_to_diameters
            );
            warn("angles.window_moved", message);
        }
        for (&id, ([from, to], fit)) in ids.iter().zip(&self.axes.windows) {
            if fit.line.is_none() {
                warn(
                    "angles.window_too_short",
                    format!(
                        "branch {id} has {:.1} mm of usable line beyond {from:.1} mm from junction {node} ({FROM_CROTCH} crotch distances or the plan's start), less than {WINDOW_MIN} graft diameter ({d:.1} mm): its angles have no value",
                        fit.covered
                    ),
                );
            } else if fit.covered < (to - from) - 0.05 * d {
                warn(
                    "angles.window_shortened",
                    format!(
                        "the fit window of branch {id} at junction {node} holds {:.1} of {:.1} graft diameters",
                        fit.covered / d,
                        (to - from) / d
                    ),
                );
            }
        }
    }
}

fn directions_of(lines: &[Option<FittedLine>]) -> Vec<Option<V3>> {
    lines.iter().map(|l| l.map(|l| l.direction)).collect()
}

/// The largest residual of an angle's legs, mm.
fn residual(lines: &[Option<FittedLine>], between: Between) -> Option<f64> {
    between.legs().into_iter().map(|leg| lines[leg].map(|l| l.rms_mm)).try_fold(0.0, |m: f64, r| Some(m.max(r?)))
}

/// What the junctions know of the branches.
struct Known<'a> {
    places: &'a [Spot],
    roles: &'a [Vec<Role>],
    fitted: &'a [Axes],
    main: Option<usize>,
}

impl Known<'_> {
    /// The junction (and leg) that names a branch: the one that the plan speaks of, else the one it leaves.
    fn home(&self, t: usize, track: &Track) -> Option<(usize, usize)> {
        let leg = |j: usize, reversed: Option<bool>| {
            self.places[j]
                .legs
                .iter()
                .position(|l| l.track == t && reversed.is_none_or(|r| l.reversed == r))
                .map(|leg| (j, leg))
        };
        self.main.and_then(|j| leg(j, None)).or_else(|| {
            let at = |node: usize, reversed| {
                self.places.iter().position(|p| p.node == node).and_then(|j| leg(j, Some(reversed)))
            };
            at(track.from_node, false).or_else(|| at(track.to_node, true))
        })
    }

    /// Both ends are junctions.
    fn between(&self, track: &Track) -> bool {
        let junction = |node: usize| self.places.iter().any(|p| p.node == node);
        junction(track.from_node) && junction(track.to_node)
    }
}

fn branch(tracks: &[Track], t: usize, known: &Known<'_>, varied: Option<&Varied>) -> Branch {
    let track = &tracks[t];
    let home = known.home(t, track);
    let role = match home {
        Some((j, leg)) if known.main == Some(j) || !known.between(track) => known.roles[j][leg],
        _ => Role::Other,
    };
    let (first, last) = (&track.sections[0], &track.sections[track.sections.len() - 1]);
    let chord = first.position.distance(last.position);
    let helix = fitted(&track.centred());
    let diameter_mm = track.diameter();
    Branch {
        id: track.id,
        role,
        from_node: track.from_node,
        to_node: track.to_node,
        length_mm: track.length(),
        tortuosity: if chord > 0.0 { track.length() / chord } else { f64::INFINITY },
        direction: home.and_then(|(j, leg)| known.fitted[j].direction(leg)),
        diameter_mm,
        diameter_band95_mm: varied.zip(diameter_mm).and_then(|(v, d)| v.diameter_band(t, d)),
        stenosis: stenosis(track),
        sections: track.sections.clone(),
        helix: helix.map(|h| varied.map_or(h.helix, |v| v.with_bands(t, &h))),
    }
}

/// Sections of a branch below which nothing is said of its narrowest place.
const STENOSIS_SECTIONS: usize = 24;

/// The narrowest usable section against a line through the median areas of the two halves of the branch, which a taper
/// follows and a narrow place does not.
fn stenosis(track: &Track) -> Option<Stenosis> {
    let areas: Vec<(f64, f64)> = (0..track.sections.len())
        .filter(|&k| track.usable(k))
        .filter_map(|k| Some((track.sections[k].abscissa_mm, track.sections[k].area_mm2?)))
        .collect();
    if areas.len() < STENOSIS_SECTIONS {
        return None;
    }
    let (first, second) = areas.split_at(areas.len() / 2);
    let middle = |part: &[(f64, f64)]| {
        Some([median(part.iter().map(|a| a.0).collect())?, median(part.iter().map(|a| a.1).collect())?])
    };
    let ([s0, a0], [s1, a1]) = (middle(first)?, middle(second)?);
    let ratio = |&(s, area): &(f64, f64)| {
        let expected = a0 + (a1 - a0) * (s - s0) / (s1 - s0);
        Stenosis { area_ratio: area / expected.max(0.5 * a0.min(a1)), abscissa_mm: s }
    };
    areas.iter().map(ratio).min_by(|a, b| a.area_ratio.total_cmp(&b.area_ratio))
}

fn warn_sections(tracks: &[Track], warnings: &mut Vec<Warning>) {
    for t in tracks {
        if t.outside > 0 {
            let message = format!(
                "{} of {} samples of branch {} lie outside the lumen and have no section",
                t.outside,
                t.sections.len(),
                t.id
            );
            warnings.push(Warning::new("sections.outside", message, Place::element(t.id)));
        }
        if t.diameter().is_none() {
            let message = format!(
                "branch {} has {:.1} mm of sections clear of junctions, openings and blind ends, less than one and a half radii: it has no diameter",
                t.id,
                t.span()
            );
            warnings.push(Warning::new("sections.short", message, Place::element(t.id)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::common_window;

    #[test]
    fn a_window_never_ends_before_it_begins() {
        assert_eq!(common_window(&[[1.0, 4.0], [2.0, 5.0], [0.5, 3.0]]), [2.0, 3.0]);
        assert_eq!(common_window(&[[1.0, 2.0], [3.0, 4.0]]), [1.0, 4.0]);
    }
}
