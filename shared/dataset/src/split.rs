//! Split of poses into held-out, calibration and other training poses.

use carff_base::random::{Key, tag};
use rand::seq::SliceRandom;

use crate::dataset::Dataset;

/// Role of a camera pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum PoseRole {
    /// Held out: never used in training.
    Unseen,
    /// Used in training, and for every threshold and choice of model.
    Calibration,
    /// Used in training; tables report these poses.
    Rest,
}

/// The poses of a dataset, split by a seed: a tenth held out, a tenth calibration, and the rest.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PoseSplit {
    roles: Vec<PoseRole>,
}

/// Name of the random stream, so that no other draw of the same run shares it.
const STREAM: u64 = tag("posesplt");

impl PoseSplit {
    /// Splits `view_count` poses. Poses in `always_train` are always in [`PoseRole::Rest`].
    pub fn new(view_count: usize, seed: u64, always_train: &[usize]) -> Self {
        Self::stratified(&vec![0; view_count], seed, always_train)
    }

    /// Splits the poses of a dataset separately for each kind of camera; the bird's-eye view is always in
    /// [`PoseRole::Rest`].
    pub fn for_dataset(dataset: &Dataset, seed: u64) -> Self {
        let mut kinds: Vec<Option<&str>> = Vec::new();
        let mut strata = vec![0; dataset.view_count()];
        for frame in dataset.frames() {
            let Some(view) = frame.view else { continue };
            let kind = frame.view_kind.as_deref();
            strata[view] = kinds.iter().position(|k| *k == kind).unwrap_or_else(|| {
                kinds.push(kind);
                kinds.len() - 1
            });
        }
        let bev_view = dataset.scenario().and_then(|s| s.bev_view);
        Self::stratified(&strata, seed, bev_view.as_slice())
    }

    fn stratified(strata: &[usize], seed: u64, always_train: &[usize]) -> Self {
        let mut rng = carff_base::random::stream(Key { seed, frame: STREAM, step: 0, sample: 0 });
        let mut roles = vec![PoseRole::Rest; strata.len()];
        let stratum_count = strata.iter().max().map_or(0, |s| s + 1);
        let mut groups: Vec<Vec<usize>> = vec![Vec::new(); stratum_count];
        let mut sizes = vec![0_usize; stratum_count];
        for (view, &stratum) in strata.iter().enumerate() {
            sizes[stratum] += 1;
            if !always_train.contains(&view) {
                groups[stratum].push(view);
            }
        }
        let quotas = tenths(&sizes);
        for (group, quota) in groups.iter_mut().zip(quotas) {
            group.shuffle(&mut rng);
            let quota = quota.min(group.len() / 2);
            for &view in &group[..quota] {
                roles[view] = PoseRole::Unseen;
            }
            for &view in &group[quota..2 * quota] {
                roles[view] = PoseRole::Calibration;
            }
        }
        Self { roles }
    }

    /// Returns the role of a pose. A pose outside the split counts as held out.
    pub fn role(&self, view: usize) -> PoseRole {
        self.roles.get(view).copied().unwrap_or(PoseRole::Unseen)
    }

    /// Returns all poses of a role, in ascending order.
    pub fn views(&self, role: PoseRole) -> Vec<usize> {
        (0..self.roles.len()).filter(|&view| self.roles[view] == role).collect()
    }

    /// Returns the number of poses.
    pub fn view_count(&self) -> usize {
        self.roles.len()
    }
}

/// Distributes a tenth of the total among groups by largest remainder, so that small groups keep their share.
fn tenths(sizes: &[usize]) -> Vec<usize> {
    let total = sizes.iter().sum::<usize>();
    let wanted = (total + 5) / 10;
    let mut quotas: Vec<usize> = sizes.iter().map(|s| s / 10).collect();
    let mut order: Vec<usize> = (0..sizes.len()).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(sizes[i] % 10), i));
    let missing = wanted.saturating_sub(quotas.iter().sum());
    for &i in order.iter().cycle().take(missing) {
        quotas[i] += 1;
    }
    quotas
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 100 poses give 10 held-out, 10 calibration and 80 other poses; equal seeds give equal splits, other seeds
    /// others.
    #[test]
    fn tenths_are_drawn_by_seed() {
        let split = PoseSplit::new(100, 7, &[]);
        assert_eq!(split.views(PoseRole::Unseen).len(), 10);
        assert_eq!(split.views(PoseRole::Calibration).len(), 10);
        assert_eq!(split.views(PoseRole::Rest).len(), 80);
        assert_eq!(split, PoseSplit::new(100, 7, &[]));
        assert_ne!(split, PoseSplit::new(100, 8, &[]));
    }

    /// A pose that must be trained on is in the rest for every seed.
    #[test]
    fn always_train_is_kept() {
        for seed in 0..50 {
            let split = PoseSplit::new(20, seed, &[3, 4]);
            assert_eq!(split.role(3), PoseRole::Rest);
            assert_eq!(split.role(4), PoseRole::Rest);
            assert_eq!(split.views(PoseRole::Unseen).len(), 2);
        }
    }

    /// Each stratum contributes a tenth: 50, 10, 18, 12 and 10 poses give 5, 1, 2, 1 and 1 to each small role.
    #[test]
    fn strata_give_their_share() {
        let sizes = [50, 10, 18, 12, 10];
        let strata: Vec<usize> = sizes.iter().enumerate().flat_map(|(i, &n)| vec![i; n]).collect();
        let split = PoseSplit::stratified(&strata, 1, &[]);
        for role in [PoseRole::Unseen, PoseRole::Calibration] {
            let mut counts = [0; 5];
            for view in split.views(role) {
                counts[strata[view]] += 1;
            }
            assert_eq!(counts, [5, 1, 2, 1, 1]);
        }
    }

    /// Very small datasets keep poses to train on, and an unknown pose counts as held out.
    #[test]
    fn small_and_unknown() {
        let split = PoseSplit::new(1, 0, &[]);
        assert_eq!(split.role(0), PoseRole::Rest);
        assert_eq!(split.role(1), PoseRole::Unseen);
        assert_eq!(PoseSplit::new(0, 0, &[]).view_count(), 0);
    }
}
