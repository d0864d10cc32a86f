//! Which poses are kept away from training, and which choose thresholds.

use carff_base::random::Key;
use rand::seq::SliceRandom;

use crate::dataset::Dataset;

/// What a camera pose is used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum PoseRole {
    /// Never trained on.
    Unseen,
    /// Trained on, and used for every threshold and choice of model.
    Calibration,
    /// Trained on, and what tables are about.
    Rest,
}

/// The poses of a set, split once by a seed: a tenth unseen, a tenth calibration, the rest.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PoseSplit {
    roles: Vec<PoseRole>,
}

/// Names this use of the run's seed, so that no other draw of the same run shares the stream.
const STREAM: u64 = 0x706f_7365_7370_6c74;

impl PoseSplit {
    /// Splits `view_count` poses. Those in `always_train` are always in [`PoseRole::Rest`].
    pub fn new(view_count: usize, seed: u64, always_train: &[usize]) -> Self {
        Self::stratified(&vec![0; view_count], seed, always_train)
    }

    /// Splits the poses of a set, so that each kind of camera has its tenths; the bird's-eye view is always in
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

    /// What a pose is used for. A pose that the split does not know is unseen.
    pub fn role(&self, view: usize) -> PoseRole {
        self.roles.get(view).copied().unwrap_or(PoseRole::Unseen)
    }

    /// All poses of one role, in ascending order.
    pub fn views(&self, role: PoseRole) -> Vec<usize> {
        (0..self.roles.len()).filter(|&view| self.roles[view] == role).collect()
    }

    /// Number of poses.
    pub fn view_count(&self) -> usize {
        self.roles.len()
    }
}

/// A tenth of the whole, handed out among groups by largest remainder, so that small groups do not vanish all at once.
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

    /// 100 poses make 10 unseen, 10 calibration, 80 rest; the same seed makes the same split, another seed another.
    #[test]
    fn tenths_are_drawn_by_seed() {
        let split = PoseSplit::new(100, 7, &[]);
        assert_eq!(split.views(PoseRole::Unseen).len(), 10);
        assert_eq!(split.views(PoseRole::Calibration).len(), 10);
        assert_eq!(split.views(PoseRole::Rest).len(), 80);
        assert_eq!(split, PoseSplit::new(100, 7, &[]));
        assert_ne!(split, PoseSplit::new(100, 8, &[]));
    }

    /// A pose that must be trained on is in the rest whatever the seed.
    #[test]
    fn always_train_is_kept() {
        for seed in 0..50 {
            let split = PoseSplit::new(20, seed, &[3, 4]);
            assert_eq!(split.role(3), PoseRole::Rest);
            assert_eq!(split.role(4), PoseRole::Rest);
            assert_eq!(split.views(PoseRole::Unseen).len(), 2);
        }
    }

    /// Each stratum gives its tenth: 50, 10, 18, 12 and 10 poses give 5, 1, 2, 1 and 1 to each small role.
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

    /// Very small sets keep poses to train on, and an unknown pose counts as unseen.
    #[test]
    fn small_and_unknown() {
        let split = PoseSplit::new(1, 0, &[]);
        assert_eq!(split.role(0), PoseRole::Rest);
        assert_eq!(split.role(1), PoseRole::Unseen);
        assert_eq!(PoseSplit::new(0, 0, &[]).view_count(), 0);
    }
}
