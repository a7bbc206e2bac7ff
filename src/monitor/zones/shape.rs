//! The area of a zone: polygons with holes, checked once and then asked for every beam.

/// Corners of all polygons of one zone. The check for crossings takes the square of it.
pub const MAX_CORNERS: usize = 1000;
/// Largest coordinate, m: no camera sees farther.
pub const MAX_COORDINATE_M: f64 = 1e5;
/// Smallest area of a polygon, m²: a beam's position is no more exact.
const MIN_AREA_M2: f64 = 0.01;

/// One or more polygons, each an outer ring and holes; corners in metres east and north.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    polygons: Vec<Polygon>,
}

/// Rings without their closing corner, the outer one first.
#[derive(Clone, Debug, PartialEq)]
struct Polygon {
    rings: Vec<Vec<[f64; 2]>>,
    low: [f64; 2],
    high: [f64; 2],
}

/// Why corners make no area.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ShapeError {
    #[error("expected a polygon, found none")]
    Empty,
    #[error("expected at least 3 corners, found {found}")]
    TooFewCorners { found: usize },
    #[error("expected at most {MAX_CORNERS} corners in a zone, found {found}")]
    TooManyCorners { found: usize },
    #[error("corner {corner}: expected two numbers between -100000 and 100000 (metres), found [{}, {}]", found[0], found[1])]
    Corner { corner: usize, found: [f64; 2] },
    #[error(
        "expected edges that do not cross, found that the edge from corner {first} meets the edge from corner {second} near ({:.3}, {:.3})",
        near[0],
        near[1]
    )]
    SelfCrossing {
        first: usize,
        second: usize,
        near: [f64; 2],
    },
    #[error("expected an area of at least {MIN_AREA_M2} m², found {found}")]
    NoArea { found: f64 },
}

impl Shape {
    /// Polygons, each a list of rings; a ring may repeat its first corner at its end.
    pub fn new(polygons: Vec<Vec<Vec<[f64; 2]>>>) -> Result<Self, ShapeError> {
        let corners = polygons.iter().flatten().map(Vec::len).sum();
        if corners > MAX_CORNERS {
            return Err(ShapeError::TooManyCorners { found: corners });
        }
        if polygons.is_empty() {
            return Err(ShapeError::Empty);
        }
        let polygons = polygons.into_iter().map(Polygon::new).collect::<Result<_, _>>()?;
        Ok(Self { polygons })
    }

    /// Distance to the nearest edge, m: positive inside, negative outside.
    pub fn depth_m(&self, p: [f64; 2]) -> f64 {
        let depths = self.polygons.iter().map(|polygon| polygon.depth_m(p));
        depths.fold(f64::NEG_INFINITY, f64::max)
    }

    /// Lower and upper corner of the box around it, m.
    pub fn bounds(&self) -> [[f64; 2]; 2] {
        let mut bounds = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
        for polygon in &self.polygons {
            for k in 0..2 {
                bounds[0][k] = bounds[0][k].min(polygon.low[k]);
                bounds[1][k] = bounds[1][k].max(polygon.high[k]);
            }
        }
        bounds
    }

    pub fn corners(&self) -> usize {
        self.polygons.iter().flat_map(|p| &p.rings).map(Vec::len).sum()
    }

    pub fn area_m2(&self) -> f64 {
        self.polygons.iter().map(Polygon::area_m2).sum()
    }

    /// Its polygons with closed rings, as GeoJSON has them.
    pub fn closed_rings(&self) -> Vec<Vec<Vec<[f64; 2]>>> {
        let close = |ring: &Vec<[f64; 2]>| ring.iter().chain(ring.first()).copied().collect();
        let of = |polygon: &Polygon| polygon.rings.iter().map(close).collect();
        self.polygons.iter().map(of).collect()
    }
}

impl Polygon {
    fn new(rings: Vec<Vec<[f64; 2]>>) -> Result<Self, ShapeError> {
        let rings: Vec<Vec<[f64; 2]>> = rings.into_iter().map(opened).collect();
        if rings.is_empty() {
            return Err(ShapeError::Empty);
        }
        let usable = |c: &f64| c.is_finite() && c.abs() <= MAX_COORDINATE_M;
        for ring in &rings {
            if let Some(k) = ring.iter().position(|corner| !corner.iter().all(usable)) {
                return Err(ShapeError::Corner {
                    corner: k + 1,
                    found: ring[k],
                });
            }
            if ring.len() < 3 {
                return Err(ShapeError::TooFewCorners { found: ring.len() });
            }
            let area = ring_area_m2(ring);
            if area < MIN_AREA_M2 {
                return Err(ShapeError::NoArea { found: area });
            }
        }
        check_crossings(&rings)?;
        let axis = |k: usize| rings[0].iter().map(move |c| c[k]);
        Ok(Self {
            low: [0, 1].map(|k| axis(k).fold(f64::INFINITY, f64::min)),
            high: [0, 1].map(|k| axis(k).fold(f64::NEG_INFINITY, f64::max)),
            rings,
        })
    }

    fn edges(&self) -> impl Iterator<Item = ([f64; 2], [f64; 2])> {
        self.rings.iter().flat_map(|ring| edges(ring))
    }

    /// Even-odd rule (Shimrat, 1962).
    fn depth_m(&self, p: [f64; 2]) -> f64 {
        let mut is_inside = false;
        let mut nearest2 = f64::INFINITY;
        for (a, b) in self.edges() {
            if (a[1] > p[1]) != (b[1] > p[1]) && p[0] < a[0] + (p[1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0]) {
                is_inside = !is_inside;
            }
            nearest2 = nearest2.min(distance2(p, a, b));
        }
        if is_inside { nearest2.sqrt() } else { -nearest2.sqrt() }
    }

    fn area_m2(&self) -> f64 {
        let areas = self.rings.iter().map(|ring| ring_area_m2(ring));
        areas
            .enumerate()
            .map(|(k, area)| if k == 0 { area } else { -area })
            .sum()
    }
}

/// The ring without the corners that repeat the one before.
fn opened(mut ring: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    ring.dedup();
    if ring.len() > 1 && ring.first() == ring.last() {
        ring.pop();
    }
    ring
}

fn edges(ring: &[[f64; 2]]) -> impl Iterator<Item = ([f64; 2], [f64; 2])> {
    let next = ring.iter().cycle().skip(1);
    ring.iter().copied().zip(next.copied())
}

/// Area within a ring (the shoelace formula).
fn ring_area_m2(ring: &[[f64; 2]]) -> f64 {
    let origin = ring.first().copied().unwrap_or_default();
    let cross = |(a, b): ([f64; 2], [f64; 2])| {
        (a[0] - origin[0]) * (b[1] - origin[1]) - (b[0] - origin[0]) * (a[1] - origin[1])
    };
    (0.5 * edges(ring).map(cross).sum::<f64>()).abs()
}

fn distance2(p: [f64; 2], a: [f64; 2], b: [f64; 2]) -> f64 {
    let (along, to) = ([b[0] - a[0], b[1] - a[1]], [p[0] - a[0], p[1] - a[1]]);
    let length2 = along[0] * along[0] + along[1] * along[1];
    let t = ((to[0] * along[0] + to[1] * along[1]) / length2.max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
    let off = [to[0] - t * along[0], to[1] - t * along[1]];
    off[0] * off[0] + off[1] * off[1]
}

/// Refuses edges that meet anywhere but at the corner that neighbours share.
fn check_crossings(rings: &[Vec<[f64; 2]>]) -> Result<(), ShapeError> {
    let mut all = Vec::new();
    let mut first = 0;
    for ring in rings {
        for (k, edge) in edges(ring).enumerate() {
            let next = first + (k + 1) % ring.len();
            all.push((first + k, next, edge));
        }
        first += ring.len();
    }
    for (i, (from, to, (a, b))) in all.iter().enumerate() {
        for (other, end, (c, d)) in &all[i + 1..] {
            let met = match (to == other, end == from) {
                // Neighbours share one corner; they must not run back over each other.
                (true, _) => runs_back(*a, *b, *d).then_some(*b),
                (_, true) => runs_back(*d, *c, *b).then_some(*a),
                _ => meeting(*a, *b, *c, *d),
            };
            if let Some(near) = met {
                return Err(ShapeError::SelfCrossing {
                    first: from + 1,
                    second: other + 1,
                    near,
                });
            }
        }
    }
    Ok(())
}

fn turn(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}

/// Whether the edge from `b` to `c` lies on the one from `a` to `b`.
fn runs_back(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> bool {
    let ahead = (b[0] - a[0]) * (c[0] - b[0]) + (b[1] - a[1]) * (c[1] - b[1]);
    turn(a, b, c) == 0.0 && ahead < 0.0
}

/// Where two edges meet.
fn meeting(a: [f64; 2], b: [f64; 2], c: [f64; 2], d: [f64; 2]) -> Option<[f64; 2]> {
    let within =
        |p: [f64; 2], a: [f64; 2], b: [f64; 2]| (0..2).all(|k| p[k] >= a[k].min(b[k]) && p[k] <= a[k].max(b[k]));
    let (of_c, of_d, of_a, of_b) = (turn(a, b, c), turn(a, b, d), turn(c, d, a), turn(c, d, b));
    if of_c * of_d < 0.0 && of_a * of_b < 0.0 {
        let t = of_a / (of_a - of_b);
        return Some([a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])]);
    }
    let touching = [(of_c, c, a, b), (of_d, d, a, b), (of_a, a, c, d), (of_b, b, c, d)];
    let touches = |(side, p, a, b): &(f64, [f64; 2], [f64; 2], [f64; 2])| *side == 0.0 && within(*p, *a, *b);
    touching.iter().find(|t| touches(t)).map(|(_, p, ..)| *p)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: [[f64; 2]; 4] = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]];

    fn one(ring: &[[f64; 2]]) -> Result<Shape, ShapeError> {
        Shape::new(vec![vec![ring.to_vec()]])
    }

    #[test]
    fn depth_is_the_distance_to_the_nearest_edge() {
        let square = one(&SQUARE).unwrap();
        for (p, depth) in [
            ([5.0, 4.0], 4.0),
            ([9.0, 5.0], 1.0),
            ([12.0, 5.0], -2.0),
            ([13.0, 14.0], -5.0),
        ] {
            assert!((square.depth_m(p) - depth).abs() < 1e-12, "{p:?}");
        }
        assert_eq!((square.area_m2(), square.corners()), (100.0, 4));
        assert_eq!(square.bounds(), [[0.0, 0.0], [10.0, 10.0]]);
        assert_eq!(square.closed_rings()[0][0].len(), 5);
    }

    #[test]
    fn a_hole_and_a_second_polygon() {
        let hole = vec![[4.0, 4.0], [6.0, 4.0], [6.0, 6.0], [4.0, 6.0], [4.0, 4.0]];
        let far = SQUARE.map(|[x, y]| [x + 100.0, y]).to_vec();
        let shape = Shape::new(vec![vec![SQUARE.to_vec(), hole], vec![far]]).unwrap();
        assert!((shape.depth_m([5.0, 5.0]) + 1.0).abs() < 1e-12);
        assert!((shape.depth_m([3.0, 5.0]) - 1.0).abs() < 1e-12);
        assert!(shape.depth_m([105.0, 5.0]) > 0.0 && shape.depth_m([50.0, 5.0]) < -30.0);
        assert_eq!(shape.area_m2(), 196.0);
    }

    #[test]
    fn corners_that_make_no_area_are_refused() {
        let refused = |ring: &[[f64; 2]]| one(ring).unwrap_err();
        assert_eq!(refused(&[]), ShapeError::TooFewCorners { found: 0 });
        assert_eq!(refused(&SQUARE[..2]), ShapeError::TooFewCorners { found: 2 });
        let closed = [SQUARE[0], SQUARE[1], SQUARE[0]];
        assert_eq!(refused(&closed), ShapeError::TooFewCorners { found: 2 });
        assert!(matches!(
            refused(&[[0.0, 0.0], [5.0, 5.0], [9.0, 9.0]]),
            ShapeError::NoArea { .. }
        ));
        assert!(matches!(
            refused(&[[0.0, f64::NAN], [5.0, 5.0], [9.0, 9.0]]),
            ShapeError::Corner { corner: 1, .. }
        ));
        assert!(matches!(
            refused(&[[0.0, 0.0], [1e6, 0.0], [0.0, 9.0]]),
            ShapeError::Corner { corner: 2, .. }
        ));
        let many: Vec<_> = (0..1001).map(|k| [f64::from(k).cos(), f64::from(k).sin()]).collect();
        assert_eq!(refused(&many), ShapeError::TooManyCorners { found: 1001 });
        assert_eq!(Shape::new(vec![]), Err(ShapeError::Empty));
        assert_eq!(Shape::new(vec![vec![]]), Err(ShapeError::Empty));
    }

    #[test]
    fn edges_that_cross_or_touch_are_refused() {
        let bow_tie = [[0.0, 0.0], [10.0, 10.0], [10.0, 0.0], [0.0, 6.0]];
        assert!(matches!(
            one(&bow_tie),
            Err(ShapeError::SelfCrossing {
                first: 1,
                second: 3,
                ..
            })
        ));
        let spike = [[0.0, 0.0], [10.0, 0.0], [5.0, 0.0], [5.0, 9.0]];
        assert!(matches!(one(&spike), Err(ShapeError::SelfCrossing { .. })));
        let touching = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [5.0, 0.0], [0.0, 10.0]];
        assert!(matches!(one(&touching), Err(ShapeError::SelfCrossing { .. })));
        // A hole that leaves its polygon.
        let hole = vec![[5.0, 5.0], [15.0, 5.0], [15.0, 8.0], [5.0, 8.0]];
        assert!(matches!(
            Shape::new(vec![vec![SQUARE.to_vec(), hole]]),
            Err(ShapeError::SelfCrossing { .. })
        ));
        let concave = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [5.0, 1.0], [0.0, 10.0]];
        assert!(one(&concave).is_ok());
    }
}
