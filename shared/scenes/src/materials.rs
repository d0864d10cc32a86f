//! Colours and procedural textures. A texture fades out where its detail is smaller than a pixel's footprint, so that
//! images have no noise at the pixel scale.

use crate::shapes::Vec3;

/// Optical properties of a surface point.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Surface {
    /// Linear RGB reflectance.
    pub albedo: Vec3,
    /// Share of the mirrored sky, 0..=1.
    pub mirror: f32,
    /// Strength of the sun's highlight.
    pub highlight: f32,
}

impl Surface {
    fn matte(albedo: Vec3) -> Self {
        Self { albedo, mirror: 0.0, highlight: 0.0 }
    }
}

/// Windows and doors of a facade. Lengths in metres.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Facade {
    pub half: Vec3,
    pub storeys: u32,
    pub window_spacing: f32,
    /// Index of the door's wall: 0 = +X, 1 = +Y, 2 = -X, 3 = -Y.
    pub door_wall: u32,
    pub brick: bool,
    pub colour: Vec3,
    pub trim: Vec3,
}

/// A body panel of a vehicle. Lengths in metres, vehicle axes (+X forward), z above the ground.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Paint {
    pub colour: Vec3,
    /// Centre of the solid above the ground and along the vehicle, for conversion to vehicle coordinates.
    pub offset: Vec3,
    pub half_length: f32,
    pub half_width: f32,
    /// Positions of the axles along x, and the radius of the wheel arch.
    pub axles: [f32; 2],
    pub arch_radius: f32,
    /// Height of head and tail lights.
    pub lights_z: f32,
}

/// The cabin: glass between sill and roof, except for the pillars.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cabin {
    pub colour: Vec3,
    pub half: Vec3,
    /// Positions of the pillars along x, cabin coordinates.
    pub pillars: [f32; 3],
}

#[derive(Clone, Copy, Debug)]
pub(crate) enum Material {
    /// A colour with blotches of the given size and strength.
    Mottled {
        colour: Vec3,
        size: f32,
        strength: f32,
    },
    /// A single colour.
    Plain {
        colour: Vec3,
    },
    /// Two alternating colours in squares of the given size, in the solid's own axes.
    Checks {
        colours: [Vec3; 2],
        size: f32,
    },
    /// A cuboid with a colour per face: +X, -X, +Y, -Y, +Z, -Z; `tiles` squares per edge, with joints of the ground
    /// colour.
    Faces {
        half: Vec3,
        colours: [Vec3; 6],
        joint: Vec3,
        tiles: f32,
    },
    /// Slabs with joints.
    Slabs {
        colour: Vec3,
        size: f32,
    },
    Grass {
        colour: Vec3,
    },
    Leaves {
        colour: Vec3,
    },
    Wall(Facade),
    Paint(Paint),
    Cabin(Cabin),
    /// Radius of the rim; the rest is the tyre. The axle is Y.
    Wheel {
        rim: f32,
    },
}

pub(crate) const ASPHALT: Vec3 = Vec3::new(0.075, 0.075, 0.082);
const GLASS: Vec3 = Vec3::new(0.022, 0.032, 0.045);

fn hash(x: i32, y: i32, z: i32) -> f32 {
    let mut h = (x as u32)
        .wrapping_mul(0x8da6_b343)
        .wrapping_add((y as u32).wrapping_mul(0xd816_3841))
        .wrapping_add((z as u32).wrapping_mul(0xcb1a_b31f));
    h ^= h >> 15;
    h = h.wrapping_mul(0x2c1b_3c6d);
    h ^= h >> 12;
    h = h.wrapping_mul(0x297a_2d39);
    h ^= h >> 15;
    (h >> 8) as f32 / (1 << 24) as f32
}

/// Returns smooth noise in -1..=1 with features of size 1.
fn noise(p: Vec3) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let u = f * f * (Vec3::splat(3.0) - f * 2.0);
    let (x, y, z) = (cell.x as i32, cell.y as i32, cell.z as i32);
    let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let layer = |z: i32| {
        lerp(lerp(hash(x, y, z), hash(x + 1, y, z), u.x), lerp(hash(x, y + 1, z), hash(x + 1, y + 1, z), u.x), u.y)
    };
    2.0 * lerp(layer(z), layer(z + 1), u.z) - 1.0
}

/// Returns 1 for detail of size `size` well above the pixel's footprint, falling to 0 below it.
fn resolved(size: f32, footprint: f32) -> f32 {
    ((size / footprint - 1.0) / 2.0).clamp(0.0, 1.0)
}

/// Returns two octaves of noise; each fades out where it cannot be resolved.
fn blotches(p: Vec3, size: f32, footprint: f32) -> f32 {
    let coarse = resolved(size, footprint);
    let fine = resolved(size * 0.4, footprint);
    let mut value = 0.0;
    if coarse > 0.0 {
        value += 0.7 * coarse * noise(p / size);
    }
    if fine > 0.0 {
        value += 0.3 * fine * noise(p / (size * 0.4) + Vec3::splat(17.3));
    }
    value
}

/// Returns the distance of `x` to the nearest multiple of `period`.
fn to_joint(x: f32, period: f32) -> f32 {
    let r = (x / period).rem_euclid(1.0);
    r.min(1.0 - r) * period
}

pub(crate) fn asphalt(p: Vec3, footprint: f32) -> Surface {
    Surface::matte(ASPHALT * (1.0 + 0.16 * blotches(p, 1.1, footprint)))
}

pub(crate) fn marking(p: Vec3, colour: Vec3, footprint: f32) -> Surface {
    Surface::matte(colour * (1.0 + 0.06 * blotches(p, 0.5, footprint)))
}

impl Material {
    /// Returns the surface at `world`, which is `local` in the solid's own axes with the local outward normal `normal`.
    /// The pixel's footprint there is about `footprint` metres.
    pub fn at(&self, world: Vec3, local: Vec3, normal: Vec3, footprint: f32) -> Surface {
        match self {
            Self::Mottled { colour, size, strength } => {
                Surface::matte(*colour * (1.0 + strength * blotches(world, *size, footprint)))
            }
            Self::Plain { colour } => Surface::matte(*colour),
            Self::Checks { colours, size } => {
                // Moved slightly inwards, so that a face on a boundary shows one layer of squares.
                let cell = ((local - normal * (0.01 * size)) / *size).floor();
                let odd = (cell.x + cell.y + cell.z).rem_euclid(2.0) > 0.5;
                let (a, b) = if odd { (colours[1], colours[0]) } else { (colours[0], colours[1]) };
                let seen = resolved(*size, footprint);
                Surface::matte(a * (0.5 + 0.5 * seen) + b * (0.5 - 0.5 * seen))
            }
            Self::Faces { half, colours, joint, tiles } => {
                let axis = (0..3).max_by(|&i, &j| normal[i].abs().total_cmp(&normal[j].abs())).unwrap_or(2);
                let in_tile = |i: usize| {
                    let at = (local[i] / half[i] * 0.5 + 0.5).clamp(0.0, 0.999) * tiles;
                    (0.09..0.91).contains(&at.fract())
                };
                let painted = in_tile((axis + 1) % 3) && in_tile((axis + 2) % 3);
                Surface::matte(if painted { colours[2 * axis + usize::from(normal[axis] < 0.0)] } else { *joint })
            }
            Self::Slabs { colour, size } => {
                let edge = to_joint(world.x, *size).min(to_joint(world.y, *size));
                let joint = if edge < 0.025 { 0.8 } else { 1.0 };
                let fade = resolved(0.12, footprint);
                let shade = 1.0 + (joint - 1.0) * fade;
                Surface::matte(*colour * (shade + 0.08 * blotches(world, 0.9, footprint)))
            }
            Self::Grass { colour } => {
                let v = 0.22 * blotches(world, 1.7, footprint) + 0.1 * blotches(world, 0.5, footprint);
                Surface::matte(*colour * (Vec3::ONE + Vec3::new(1.2, 1.0, 0.8) * v))
            }
            Self::Leaves { colour } => {
                let v = 0.3 * blotches(world, 0.55, footprint);
                let light = 0.85 + 0.15 * normal.z;
                Surface::matte(*colour * ((1.0 + v) * light))
            }
            Self::Wall(facade) => facade.at(world, local, normal, footprint),
            Self::Paint(paint) => paint.at(local, normal),
            Self::Cabin(cabin) => cabin.at(local, normal),
            Self::Wheel { rim } => {
                let radius = local.x.hypot(local.z);
                if normal.y.abs() > 0.5 && radius < *rim {
                    let hub = if radius < 0.3 * rim { 0.25 } else { 0.45 };
                    Surface { albedo: Vec3::splat(hub), mirror: 0.1, highlight: 0.2 }
                } else {
                    Surface::matte(Vec3::splat(0.018))
                }
            }
        }
    }
}

impl Facade {
    fn at(&self, world: Vec3, local: Vec3, normal: Vec3, footprint: f32) -> Surface {
        if normal.z.abs() > 0.5 {
            return Surface::matte(Vec3::new(0.27, 0.268, 0.26) * (1.0 + 0.16 * blotches(world, 1.3, footprint)));
        }
        let (along, half, wall) = if normal.x.abs() > normal.y.abs() {
            (local.y, self.half.y, if normal.x > 0.0 { 0 } else { 2 })
        } else {
            (local.x, self.half.x, if normal.y > 0.0 { 1 } else { 3 })
        };
        let z = local.z + self.half.z;
        let storey_height = 2.0 * self.half.z / self.storeys as f32;
        let count = ((2.0 * half - 0.8) / self.window_spacing).floor().max(1.0);
        let spacing = 2.0 * half / count;
        let column = ((along + half) / spacing).floor().clamp(0.0, count - 1.0);
        let x = along + half - (column + 0.5) * spacing;
        let storey = (z / storey_height).floor().clamp(0.0, self.storeys as f32 - 1.0);
        let y = z - storey * storey_height;
        let is_door = wall == self.door_wall && storey == 0.0 && column == (count / 2.0).floor();
        if is_door {
            let (half_width, top) = (0.55, 2.15);
            if x.abs() < half_width && y < top {
                if y > 1.35 && y < 1.9 && x.abs() < 0.32 {
                    return Surface { albedo: GLASS, mirror: 0.2, highlight: 0.3 };
                }
                return Surface { albedo: Vec3::new(0.10, 0.045, 0.025), mirror: 0.03, highlight: 0.1 };
            }
            if x.abs() < half_width + 0.12 && y < top + 0.12 {
                return Surface::matte(self.trim);
            }
        } else {
            let half_width = (0.31 * spacing).min(0.85);
            let (low, high) = (0.36 * storey_height, 0.80 * storey_height);
            if x.abs() < half_width && y > low && y < high {
                let bar = x.abs() < 0.035 || (y - 0.5 * (low + high)).abs() < 0.03;
                if bar && footprint < 0.14 {
                    return Surface::matte(self.trim);
                }
                return Surface { albedo: GLASS, mirror: 0.28, highlight: 0.4 };
            }
            if x.abs() < half_width + 0.09 && y > low - 0.13 && y < high + 0.09 {
                return Surface::matte(self.trim);
            }
        }
        if y > storey_height - 0.16 && self.storeys > 1 && storey + 1.0 < self.storeys as f32 || z < 0.35 {
            return Surface::matte(self.trim * 0.75);
        }
        let mut shade = 1.0 + 0.16 * blotches(world, 0.9, footprint);
        if self.brick {
            // Bricks have twice their natural size: smaller ones would not be visible at these resolutions.
            let course = 0.16;
            let row = (z / course).floor();
            let joint = to_joint(z, course) < 0.016
                || to_joint(along + if (row as i32) % 2 == 0 { 0.0 } else { 0.22 }, 0.44) < 0.016;
            let fade = resolved(0.07, footprint);
            if fade > 0.0 {
                let tone =
                    hash(row as i32, ((along + 0.22 * (row.rem_euclid(2.0))) / 0.44).floor() as i32, wall as i32);
                shade *= 1.0 + fade * (0.22 * (tone - 0.5));
                if joint {
                    shade *= 1.0 + 0.35 * fade;
                }
            }
        }
        Surface::matte(self.colour * shade)
    }
}

impl Paint {
    fn at(&self, local: Vec3, normal: Vec3) -> Surface {
        let p = local + self.offset;
        let paint = Surface { albedo: self.colour, mirror: 0.05, highlight: 0.25 };
        let dark = Surface::matte(Vec3::splat(0.02));
        if normal.y.abs() > 0.6 {
            for axle in self.axles {
                if (p.x - axle).hypot(p.z - 0.36) < self.arch_radius {
                    return dark;
                }
            }
        }
        if p.z < 0.42 {
            return dark;
        }
        let side = p.y.abs() / self.half_width;
        if normal.x.abs() > 0.5 && (p.z - self.lights_z).abs() < 0.1 && p.x.abs() > 0.8 * self.half_length {
            if side > 0.58 && side < 0.93 {
                return if p.x > 0.0 {
                    Surface { albedo: Vec3::new(0.85, 0.85, 0.78), mirror: 0.1, highlight: 0.5 }
                } else {
                    Surface { albedo: Vec3::new(0.55, 0.02, 0.02), mirror: 0.05, highlight: 0.3 }
                };
            }
            if p.x > 0.0 && side < 0.5 {
                return dark;
            }
        }
        if normal.x.abs() > 0.5 && p.z < 0.6 && side > 0.0 && p.z < self.lights_z - 0.14 {
            return Surface::matte(Vec3::splat(0.07));
        }
        paint
    }
}

impl Cabin {
    fn at(&self, local: Vec3, normal: Vec3) -> Surface {
        let paint = Surface { albedo: self.colour, mirror: 0.05, highlight: 0.25 };
        let glass = Surface { albedo: GLASS, mirror: 0.3, highlight: 0.5 };
        if normal.z > 0.88 || local.z < -self.half.z + 0.06 || local.z > self.half.z - 0.09 {
            return paint;
        }
        if normal.y.abs() > 0.6 {
            if self.pillars.iter().any(|x| (local.x - x).abs() < 0.06) {
                return paint;
            }
            return glass;
        }
        if local.y.abs() > self.half.y * 0.86 - 0.1 * (local.z + self.half.z) { paint } else { glass }
    }
}
