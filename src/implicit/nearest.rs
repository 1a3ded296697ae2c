//! Farthest-first order of points and the nearest neighbours among the points that come earlier in an order.
//!
//! A median-split tree of tight boxes serves both. Every node knows the smallest rank below it, so that a search for
//! earlier points skips whatever holds only later ones: n searches of k neighbours cost O(n k log n) for any order whose
//! first points are spread out. The crate kiddo was rejected: its growing tree refuses more than a bucket of points with
//! an equal coordinate, which every axial slice has.

use exec::{Cancelled, Ctx};

/// Points per leaf.
const LEAF: usize = 8;

struct Node {
    low: [f64; 3],
    high: [f64; 3],
    first: usize,
    last: usize,
    least_rank: u32,
    children: Option<[usize; 2]>,
}

/// Boxes over points.
pub(crate) struct Tree<'a> {
    points: &'a [[f64; 3]],
    /// Point numbers; a node owns a range of them.
    index: Vec<u32>,
    nodes: Vec<Node>,
}

pub(crate) fn distance2(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    let d = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
}

impl<'a> Tree<'a> {
    /// A tree over all points (at most 2^32).
    pub(crate) fn new(points: &'a [[f64; 3]]) -> Self {
        let mut tree = Self { points, index: (0..points.len() as u32).collect(), nodes: Vec::new() };
        if !points.is_empty() {
            tree.grow(0, points.len());
        }
        tree
    }

    fn grow(&mut self, first: usize, last: usize) -> usize {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for &i in &self.index[first..last] {
            for a in 0..3 {
                low[a] = low[a].min(self.points[i as usize][a]);
                high[a] = high[a].max(self.points[i as usize][a]);
            }
        }
        let at = self.nodes.len();
        self.nodes.push(Node { low, high, first, last, least_rank: 0, children: None });
        if last - first > LEAF {
            let wide = |a: usize| high[a] - low[a];
            let axis = (1..3).fold(0, |w, a| if wide(a) > wide(w) { a } else { w });
            let middle = (last - first) / 2;
            let points = self.points;
            self.index[first..last].select_nth_unstable_by(middle, |&i, &j| {
                points[i as usize][axis].total_cmp(&points[j as usize][axis]).then(i.cmp(&j))
            });
            let left = self.grow(first, first + middle);
            let right = self.grow(first + middle, last);
            self.nodes[at].children = Some([left, right]);
        }
        at
    }

    fn box_distance2(&self, node: usize, x: &[f64; 3]) -> f64 {
        let n = &self.nodes[node];
        (0..3).fold(0.0, |s, a| {
            let d = (n.low[a] - x[a]).max(x[a] - n.high[a]).max(0.0);
            s + d * d
        })
    }

    /// Calls `f(point, squared distance)` for the points within `radius2` (squared) of `x`.
    pub(crate) fn within(&self, x: &[f64; 3], radius2: f64, stack: &mut Vec<usize>, mut f: impl FnMut(usize, f64)) {
        stack.clear();
        stack.push(0);
        while let Some(node) = stack.pop() {
            if self.box_distance2(node, x) > radius2 {
                continue;
            }
            if let Some(children) = self.nodes[node].children {
                stack.extend(children);
                continue;
            }
            for &i in &self.index[self.nodes[node].first..self.nodes[node].last] {
                let d = distance2(x, &self.points[i as usize]);
                if d <= radius2 {
                    f(i as usize, d);
                }
            }
        }
    }

    /// Tells the tree the rank of every point, for [`Tree::earlier`].
    pub(crate) fn rank(&mut self, rank: &[u32]) {
        // children follow their parent, so that going backwards meets them first
        for at in (0..self.nodes.len()).rev() {
            let (first, last) = (self.nodes[at].first, self.nodes[at].last);
            self.nodes[at].least_rank = match self.nodes[at].children {
                Some([a, b]) => self.nodes[a].least_rank.min(self.nodes[b].least_rank),
                None => {
                    self.index[first..last].sort_unstable_by_key(|&i| rank[i as usize]);
                    rank[self.index[first] as usize]
                }
            };
        }
    }

    /// The `k` points nearest to point `i` among those of smaller rank, in no useful order but always the same.
    pub(crate) fn earlier(&self, i: usize, k: usize, rank: &[u32], search: &mut Search) {
        let x = &self.points[i];
        let own = rank[i];
        search.found.clear();
        search.stack.clear();
        search.stack.push((0.0, 0));
        while let Some((near, node)) = search.stack.pop() {
            let full = search.found.len() == k;
            if full && near >= search.found[k - 1].0 {
                continue;
            }
            if let Some([a, b]) = self.nodes[node].children {
                let mut next = [(self.box_distance2(a, x), a), (self.box_distance2(b, x), b)];
                if next[0].0 < next[1].0 {
                    next.swap(0, 1);
                }
                search.stack.extend(next.into_iter().filter(|c| self.nodes[c.1].least_rank < own));
                continue;
            }
            for &j in &self.index[self.nodes[node].first..self.nodes[node].last] {
                if rank[j as usize] >= own {
                    break;
                }
                search.offer(distance2(x, &self.points[j as usize]), j, k);
            }
        }
    }
}

/// Room for searches, kept from one to the next.
#[derive(Default)]
pub(crate) struct Search {
    /// (squared distance, point), ascending.
    pub(crate) found: Vec<(f64, u32)>,
    stack: Vec<(f64, usize)>,
}

impl Search {
    fn offer(&mut self, d: f64, j: u32, k: usize) {
        if self.found.len() == k {
            if d >= self.found[k - 1].0 {
                return;
            }
            self.found.pop();
        }
        let at = self.found.partition_point(|f| (f.0, f.1) < (d, j));
        self.found.insert(at, (d, j));
    }
}

/// A point that waits for its turn; stale entries have a larger distance than the point has now.
#[derive(PartialEq)]
struct Waiting(f64, u32);
impl Eq for Waiting {}
impl PartialOrd for Waiting {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Waiting {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.0.total_cmp(&other.0).then(other.1.cmp(&self.1))
    }
}

/// All points in farthest-first order: first four that span space as widely as four can, then always the point farthest
/// from all before it.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn farthest_first(tree: &Tree<'_>, ctx: &Ctx) -> Result<Vec<u32>, Cancelled> {
    let points = tree.points;
    let mut order: Vec<u32> = corners(points);
    let mut taken = vec![false; points.len()];
    let mut gap: Vec<f64> = vec![f64::INFINITY; points.len()];
    for &c in &order {
        taken[c as usize] = true;
        for (g, p) in gap.iter_mut().zip(points) {
            *g = g.min(distance2(p, &points[c as usize]));
        }
    }
    let waiting = (0..points.len()).filter(|&i| !taken[i]).map(|i| Waiting(gap[i], i as u32));
    let mut heap: std::collections::BinaryHeap<Waiting> = waiting.collect();
    let mut stack = Vec::new();
    while let Some(Waiting(d, i)) = heap.pop() {
        let i = i as usize;
        if taken[i] || d > gap[i] {
            continue;
        }
        if order.len().is_multiple_of(4096) {
            ctx.check()?;
        }
        taken[i] = true;
        order.push(i as u32);
        tree.within(&points[i], d, &mut stack, |j, d| {
            if d < gap[j] && !taken[j] {
                gap[j] = d;
                heap.push(Waiting(d, j as u32));
            }
        });
    }
    Ok(order)
}

/// Up to four points of a wide simplex: the farthest from the mean, then from the point, the line and the plane so far.
fn corners(points: &[[f64; 3]]) -> Vec<u32> {
    let n = points.len() as f64;
    let mean = points.iter().fold([0.0; 3], |m, p| [m[0] + p[0] / n, m[1] + p[1] / n, m[2] + p[2] / n]);
    let sub = |p: &[f64; 3], q: &[f64; 3]| [p[0] - q[0], p[1] - q[1], p[2] - q[2]];
    let farthest = |rest: &[[f64; 3]]| {
        let length2 = |i: usize| distance2(&rest[i], &[0.0; 3]);
        (1..rest.len()).fold(0, |w, i| if length2(i) > length2(w) { i } else { w })
    };
    let mut rest: Vec<[f64; 3]> = points.iter().map(|p| sub(p, &mean)).collect();
    let mut out: Vec<u32> = Vec::new();
    for step in 0..4.min(points.len()) {
        let far = farthest(&rest);
        if out.contains(&(far as u32)) {
            break;
        }
        out.push(far as u32);
        let v = rest[far];
        let vv = distance2(&v, &[0.0; 3]).max(f64::MIN_POSITIVE);
        for r in &mut rest {
            let along = if step == 0 { 1.0 } else { (r[0] * v[0] + r[1] * v[1] + r[2] * v[2]) / vv };
            *r = [r[0] - along * v[0], r[1] - along * v[1], r[2] - along * v[2]];
        }
    }
    out
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn cloud(n: usize) -> Vec<[f64; 3]> {
        let f = |i: usize, a: f64| ((i as f64 * a).sin() * 43_758.545).fract();
        // a third of the points in one plane, some coincident
        (0..n)
            .map(|i| [f(i + 1, 12.98), f(i + 1, 78.23), if i % 3 == 0 { 0.25 } else { f(i % (n - 9), 37.72) }])
            .collect()
    }

    #[test]
    fn neighbours_are_those_of_a_full_search() {
        let points = cloud(900);
        let mut tree = Tree::new(&points);
        let order = farthest_first(&tree, &Ctx::new(1).unwrap()).unwrap();
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert!(sorted.iter().enumerate().all(|(i, &p)| p == i as u32), "the order is a permutation");
        let mut rank = vec![0; points.len()];
        order.iter().enumerate().for_each(|(r, &i)| rank[i as usize] = r as u32);
        tree.rank(&rank);
        let mut search = Search::default();
        for (r, &i) in order.iter().enumerate() {
            tree.earlier(i as usize, 20, &rank, &mut search);
            let mut all: Vec<f64> =
                order[..r].iter().map(|&j| distance2(&points[i as usize], &points[j as usize])).collect();
            all.sort_by(f64::total_cmp);
            all.truncate(20);
            assert_eq!(search.found.iter().map(|f| f.0).collect::<Vec<_>>(), all);
        }
    }

    #[test]
    fn the_order_is_farthest_first_after_its_corners() {
        let points = cloud(300);
        let order = farthest_first(&Tree::new(&points), &Ctx::new(1).unwrap()).unwrap();
        let gap = |i: u32, before: &[u32]| {
            before.iter().fold(f64::INFINITY, |m, &j| m.min(distance2(&points[i as usize], &points[j as usize])))
        };
        for r in 4..300 {
            let taken = gap(order[r], &order[..r]);
            assert!(order[r + 1..].iter().all(|&i| gap(i, &order[..r]) <= taken));
        }
    }
}
