//! Checks of a scenario file that concern several keys; errors have the line.

use super::{Actor, Placement};
use crate::config::ScenarioConfig;
use crate::error::ScenarioError;
use crate::movers::{Mover, Pose, movers};
use std::path::Path;
use toml::Spanned;

/// Converts positions in the text to line numbers.
pub(super) struct Source<'a> {
    pub path: &'a Path,
    pub text: &'a str,
}

impl Source<'_> {
    pub fn error(&self, offset: usize, key: &str, problem: impl Into<String>) -> ScenarioError {
        let line = self.text.bytes().take(offset).filter(|b| *b == b'\n').count() + 1;
        ScenarioError::Key { path: self.path.to_owned(), line, key: key.to_owned(), problem: problem.into() }
    }

    pub fn error_at<T>(&self, value: &Spanned<T>, key: &str, problem: impl Into<String>) -> ScenarioError {
        self.error(value.span().start, key, problem)
    }

    /// Returns an error at the first line that sets a key, for keys without a stored position.
    pub fn error_in(&self, key: &str, problem: impl Into<String>) -> ScenarioError {
        let is_key = |line: &str| {
            line.trim_start()
                .trim_start_matches('[')
                .strip_prefix(key)
                .is_some_and(|rest| rest.trim_start().starts_with('=') || rest.starts_with(']'))
        };
        let offset: usize = self.text.split_inclusive('\n').take_while(|l| !is_key(l)).map(str::len).sum();
        self.error(if offset == self.text.len() { 0 } else { offset }, key, problem)
    }
}

/// Places a mover by its courses; `replaces` sets the pose and returns whether the mover was already placed.
fn place(
    source: &Source,
    config: &ScenarioConfig,
    mover: Mover,
    branch_index: impl Fn(&Spanned<String>, &str) -> Result<usize, ScenarioError>,
    mut replaces: impl FnMut(usize, usize, Pose) -> bool,
) -> Result<(), ScenarioError> {
    let known = mover.variants();
    for course in mover.courses() {
        let each = |found: usize, what: &str| {
            (found != config.timestamps)
                .then(|| format!("{found} {what}; one for each of the {} timestamps is needed", config.timestamps))
        };
        if let Some(problem) = each(course.poses.len(), "poses") {
            return Err(source.error(course.poses_at.start, "poses", problem));
        }
        if course.poses.iter().flatten().any(|value| value.is_nan() || value.abs() > 1e5) {
            let problem = match mover {
                Mover::Vehicle(_) => "a value is out of range; [x, y, yaw in degrees]",
                Mover::Object(_) => "a value is out of range; [x, y, z, yaw in degrees]",
            };
            return Err(source.error(course.poses_at.start, "poses", problem));
        }
        let mut variants = vec![None; config.timestamps];
        if let Some(names) = course.variants {
            if let Some(problem) = each(names.get_ref().len(), "variants") {
                return Err(source.error_at(names, "variants", problem));
            }
            for (variant, name) in variants.iter_mut().zip(names.get_ref()) {
                let Some(index) = known.iter().position(|k| k == name) else {
                    let hint = carff_base::names::hint(name, known.iter().copied());
                    let problem = format!("no part has the variant `{name}`; there are {known:?}{hint}");
                    return Err(source.error_at(names, "variants", problem));
                };
                *variant = Some(index);
            }
        }
        for name in course.branches {
            let branch = branch_index(name, "branches")?;
            for (timestamp, ([x, y, z, yaw], variant)) in course.poses.iter().zip(&variants).enumerate() {
                let pose = Pose { position_m: [*x, *y, *z], yaw: yaw.to_radians(), variant: *variant };
                if replaces(branch, timestamp, pose) {
                    let problem = format!("`{}` has two courses in branch `{}`", mover.name(), name.get_ref());
                    return Err(source.error_at(name, "branches", problem));
                }
            }
        }
    }
    Ok(())
}

/// Placements by branch and time step, the actor, and the hazard branches.
pub(super) type Checked = (Vec<Vec<Placement>>, Option<Actor>, Vec<usize>);

/// Checks cross-references: names, lengths of courses, at most one dynamic mover.
pub(super) fn check(source: &Source, config: &ScenarioConfig) -> Result<Checked, ScenarioError> {
    if config.branches.is_empty() || config.branches.len() > 64 {
        return Err(source.error_in("branches", format!("{} names; from 1 to 64 are allowed", config.branches.len())));
    }
    if (0..3).any(|i| config.bounds_m[0][i] >= config.bounds_m[1][i]) {
        return Err(source.error_in("bounds_m", "the first corner must be below the second along every axis"));
    }
    for (i, name) in config.branches.iter().enumerate() {
        if config.branches[..i].contains(name) {
            return Err(source.error_in("branches", format!("`{name}` is named twice")));
        }
    }
    let known = || config.branches.iter().map(|b| format!("`{b}`")).collect::<Vec<_>>().join(", ");
    let branch_index = |name: &Spanned<String>, key: &str| {
        config.branches.iter().position(|b| b == name.get_ref()).ok_or_else(|| {
            let hint = carff_base::names::hint(name.get_ref(), config.branches.iter().map(String::as_str));
            let problem = format!("there is no branch `{}`; there are {}{hint}", name.get_ref(), known());
            source.error_at(name, key, problem)
        })
    };
    let hazard_branches =
        config.hazard_branches.iter().map(|b| branch_index(b, "hazard_branches")).collect::<Result<Vec<_>, _>>()?;
    let from = &config.hazard_from_timestamp;
    if *from.get_ref() >= config.timestamps {
        let problem = format!("is {}, but the time steps are 0 to {}", from.get_ref(), config.timestamps - 1);
        return Err(source.error_at(from, "hazard_from_timestamp", problem));
    }
    for (key, boxes) in [
        ("slab", config.slab.iter().map(|b| (b.min, b.max)).collect::<Vec<_>>()),
        ("building", config.building.iter().map(|b| (b.min, b.max)).collect()),
    ] {
        if let Some((min, max)) = boxes.iter().find(|(min, max)| min[0] >= max[0] || min[1] >= max[1]) {
            return Err(source.error_in(key, format!("`min` {min:?} must be below `max` {max:?} along both axes")));
        }
    }
    let count = movers(config).count();
    let mut placements = vec![vec![vec![None; count]; config.timestamps]; config.branches.len()];
    let mut dynamic = None;
    for (m, mover) in movers(config).enumerate() {
        if movers(config).take(m).any(|other| other.name() == mover.name()) {
            return Err(source.error_in(mover.key(), format!("`{}` is named twice", mover.name())));
        }
        if mover.dynamic() && dynamic.replace(m).is_some() {
            return Err(source.error_in("dynamic", "more than one vehicle or object is dynamic; at most one may be"));
        }
        if let Some(pose) = mover.still() {
            placements.iter_mut().flatten().for_each(|placement| placement[m] = Some(pose));
        }
        place(source, config, mover, branch_index, |branch, timestamp, pose| {
            placements[branch][timestamp][m].replace(pose).is_some()
        })?;
    }
    let mut followers = Vec::new();
    for (m, mover) in movers(config).enumerate() {
        let Some(leader) = mover.follows() else { continue };
        let is_leader = |d: usize| movers(config).nth(d).is_some_and(|l| l.name() == leader.get_ref()) && d != m;
        if !dynamic.is_some_and(is_leader) {
            let hint =
                carff_base::names::hint(leader.get_ref(), movers(config).filter(Mover::dynamic).map(|m| m.name()));
            let problem = format!("`{}` is not another, dynamic vehicle or object{hint}", leader.get_ref());
            return Err(source.error_at(leader, "follows", problem));
        }
        followers.push(m);
    }
    let actor = dynamic.map(|dynamic| Actor { dynamic, followers });
    for group in &config.dash {
        if !config.vehicle.iter().any(|v| v.name == *group.vehicle.get_ref()) {
            let hint = carff_base::names::hint(group.vehicle.get_ref(), config.vehicle.iter().map(|v| v.name.as_str()));
            let problem = format!("there is no vehicle `{}`{hint}", group.vehicle.get_ref());
            return Err(source.error_at(&group.vehicle, "vehicle", problem));
        }
    }
    check_variations(source, config)?;
    Ok((placements, actor, hazard_branches))
}

/// Checks that appearances have a dynamic vehicle, and that names of variations and routes occur once.
fn check_variations(source: &Source, config: &ScenarioConfig) -> Result<(), ScenarioError> {
    if !config.appearance.is_empty() && !config.vehicle.iter().any(|v| v.dynamic) {
        return Err(source.error_in("appearance", "no vehicle is dynamic; set `dynamic = true` of the one to replace"));
    }
    let twice =
        |names: Vec<&str>| (1..names.len()).find(|i| names[..*i].contains(&names[*i])).map(|i| names[i].to_owned());
    if let Some(name) = twice(config.appearance.iter().map(|a| a.name.as_str()).collect()) {
        return Err(source.error_in("appearance", format!("`{name}` is named twice")));
    }
    if let Some(name) = twice(config.closed_loop.iter().map(|route| route.name.as_str()).collect()) {
        return Err(source.error_in("closed_loop", format!("`{name}` is named twice")));
    }
    let objects = movers(config).map(|m| m.name()).chain(config.bystander.iter().map(|b| b.name.as_str()));
    match twice(objects.collect()) {
        Some(name) => Err(source.error_in("bystander", format!("`{name}` is named twice"))),
        None => Ok(()),
    }
}
