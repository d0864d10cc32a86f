//! What the window is about, without a window: an image, the scenes that it may stand for, and what follows.
//!
//! *Toggle* takes an image to its posterior. *Predict* forecasts one step: a mixture, and latents drawn from it.
//! *Probe and predict* asks the shown scene what stands where, takes the posterior of the state that it shows for the
//! next input, and forecasts from that, up to the horizon. All of it is computed by the functions that the stages use.

use crate::history::History;
use crate::input::Input;
use crate::journal::{Decision, Journal};
use crate::models::Models;
use carff_decision::{Draw, Evidence, Mixture, Probed, Resolved, Sampling, Step, path_probability};
use carff_messages::{Gaussian, LATENT_DIM, MAX_HORIZON, MAX_SAMPLES};
use std::sync::Arc;
use std::time::Instant;

/// How far and how finely to look ahead, and with which random numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Latents drawn a step, 1..=64.
    pub samples: usize,
    /// How they are spread over the components.
    pub sampling: Sampling,
    /// Steps that may be looked ahead, 1..=8.
    pub horizon: u32,
    /// Seed of the draws.
    pub seed: u64,
}

/// Which scene is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Selection {
    /// That of the forecast's input: the image's posterior, or the state that was fed back.
    Source,
    /// That of a mixture component's mean.
    Component(usize),
    /// That of a drawn latent.
    Sample(usize),
    /// That of a known state.
    State(usize),
}

/// What probing the shown scene found.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// Occupancy of each place, and what they stand for.
    pub probed: Probed,
    /// Density at each of the prober's points, 1/m.
    pub densities: Vec<f32>,
}

/// A forecast: the mixture over the next latent, and what was drawn from it.
#[derive(Clone, Debug, PartialEq)]
pub struct Forecast {
    /// The mixture.
    pub mixture: Mixture,
    /// The draws.
    pub draws: Vec<Draw>,
}

/// One entry of the history: an input, and what has been made of it so far.
#[derive(Clone, Debug)]
pub struct Moment {
    /// The image that all rests on.
    pub input: Arc<Input>,
    /// Steps ahead of the image.
    pub step: u32,
    /// What is forecast from: the image's posterior, or that of a known state.
    pub source: Gaussian,
    /// That state; `None` for an image's posterior.
    pub source_state: Option<usize>,
    /// The forecast; none at step 0.
    pub forecast: Option<Forecast>,
    /// What probing all of the forecast's scenes found; none before it is probed.
    pub belief: Option<Step>,
    /// Which scene is shown.
    pub selection: Selection,
    /// Whether a hand chose it.
    pub is_chosen: bool,
    /// What probing the shown scene found; none before it is probed.
    pub found: Option<Found>,
    /// Probability of the path followed up to here.
    pub path_probability: f32,
    /// The probed steps of this path before this one.
    pub path: Vec<Step>,
}

impl Moment {
    /// An image's posterior, nothing more.
    pub fn of_posterior(input: Arc<Input>, posterior: Gaussian) -> Self {
        Self {
            input,
            step: 0,
            source: posterior,
            source_state: None,
            forecast: None,
            belief: None,
            selection: Selection::Source,
            is_chosen: false,
            found: None,
            path_probability: 1.0,
            path: Vec::new(),
        }
    }

    /// A forecast's scenes; the most probable component is shown.
    pub fn of_forecast(before: &Self, step: u32, forecast: Forecast) -> Self {
        let weights = &forecast.mixture.weights;
        let heaviest = (0..weights.len()).max_by(|&a, &b| weights[a].total_cmp(&weights[b]));
        Self {
            step,
            selection: heaviest.map_or(Selection::Source, Selection::Component),
            is_chosen: false,
            forecast: Some(forecast),
            belief: None,
            found: None,
            ..before.clone()
        }
    }

    /// The probed steps up to this one.
    pub fn steps(&self) -> impl Iterator<Item = &Step> {
        self.path.iter().chain(&self.belief)
    }
}

/// A scene to choose, or to show.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Which.
    pub selection: Selection,
    /// Its latent.
    pub latent: [f32; LATENT_DIM],
    /// What it is called.
    pub name: String,
    /// What probing found, once it has been probed.
    pub probed: Option<Probed>,
    /// The share of the forecast that it stands for, 0..=1.
    pub share: Option<f32>,
}

/// Why something cannot be done.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SessionError {
    /// Nothing was toggled yet.
    #[error("no image yet: choose one, and press Toggle")]
    NoInput,
    /// The encoder refused the image.
    #[error("`{title}` is no image that the encoder can read: {width_px} x {height_px} pixels")]
    Picture {
        /// What it is called.
        title: String,
        /// Its width, pixels.
        width_px: u32,
        /// Its height, pixels.
        height_px: u32,
    },
    /// The checkpoint cannot forecast.
    #[error("{0}")]
    NoMixture(String),
    /// The shown scene is none of the known states.
    #[error("the shown scene is none of the known states, so there is nothing to go on from: choose another one")]
    Unknown,
    /// No further step.
    #[error("step {step} is the last of the horizon: go back, or set a longer horizon")]
    Horizon {
        /// The step that is shown.
        step: u32,
    },
    /// There is no such scene.
    #[error("there is no such scene to show: forecast first")]
    NoScene,
}

/// The models, what was looked at with them, and what came of it.
pub struct Session {
    models: Models,
    history: History<Moment>,
    settings: Settings,
    /// Decisions and times.
    pub journal: Journal,
}

impl Session {
    /// With nothing looked at yet.
    pub fn new(models: Models) -> Self {
        let settings =
            Settings { samples: 10, sampling: Sampling::Stratified, horizon: models.horizon().max(2), seed: 1 };
        Self { models, history: History::default(), settings, journal: Journal::default() }
    }

    /// The models.
    pub fn models(&self) -> &Models {
        &self.models
    }

    /// The settings.
    pub fn settings(&self) -> Settings {
        self.settings
    }

    /// Sets them, within their limits; they count for what is forecast from now on.
    pub fn set_settings(&mut self, settings: Settings) {
        self.settings = Settings {
            samples: settings.samples.clamp(1, MAX_SAMPLES),
            horizon: settings.horizon.clamp(1, MAX_HORIZON),
            ..settings
        };
    }

    /// What was looked at.
    pub fn history(&self) -> &History<Moment> {
        &self.history
    }

    /// What is looked at.
    pub fn moment(&self) -> Option<&Moment> {
        self.history.current()
    }

    fn current(&self) -> Result<&Moment, SessionError> {
        self.moment().ok_or(SessionError::NoInput)
    }

    /// **Toggle**: the scene that an image's posterior stands for.
    pub fn toggle(&mut self, input: Arc<Input>) -> Result<(), SessionError> {
        let started = Instant::now();
        let Some(posterior) = self.models.encode(&input.image) else {
            let (width_px, height_px) = (input.image.width_px, input.image.height_px);
            return Err(SessionError::Picture { title: input.title.clone(), width_px, height_px });
        };
        self.journal.took_next("encoder", ms(started));
        let moment = Moment::of_posterior(input, posterior);
        let is_last = !self.history.has_forward();
        match self.history.current_mut() {
            // Leafing through images leaves no trail.
            Some(shown) if is_last && shown.step == 0 && shown.found.is_none() => *shown = moment,
            _ => self.history.push(moment),
        }
        Ok(())
    }

    /// Whether [`Session::predict`] would do something, or why not.
    pub fn can_predict(&self) -> Result<(), SessionError> {
        let moment = self.current()?;
        self.can_forecast(moment.step.max(1))
    }

    fn can_forecast(&self, step: u32) -> Result<(), SessionError> {
        if let Err(why) = &self.models.mixture {
            return Err(SessionError::NoMixture(why.clone()));
        }
        if step > self.settings.horizon { Err(SessionError::Horizon { step: step - 1 }) } else { Ok(()) }
    }

    /// **Predict**: the mixture over what comes one step after the image, and latents drawn from it. Where a step is
    /// shown already, it is drawn again, with the settings as they are now.
    pub fn predict(&mut self) -> Result<(), SessionError> {
        self.can_predict()?;
        let moment = self.current()?.clone();
        let step = moment.step.max(1);
        let forecast = self.forecast(&moment.source, &moment.input, step)?;
        let next = Moment::of_forecast(&moment, step, forecast);
        match self.history.current_mut() {
            Some(shown) if shown.step == step => *shown = next,
            _ => self.history.push(next),
        }
        Ok(())
    }

    /// One step's forecast, as the forecaster stage draws it for a frame of this number.
    fn forecast(&mut self, source: &Gaussian, input: &Input, step: u32) -> Result<Forecast, SessionError> {
        let started = Instant::now();
        let net = self.models.mixture.as_ref().map_err(|why| SessionError::NoMixture(why.clone()))?;
        let mixture = net.forecast(source);
        let Settings { samples, sampling, seed, .. } = self.settings;
        let draws = mixture.draw(samples, sampling, input.seed.unwrap_or(seed), input.frame, step);
        self.journal.took_next("forecaster", ms(started));
        Ok(Forecast { mixture, draws })
    }

    /// **Probe**: what stands where in the shown scene, and, of a forecast, in all others: the belief.
    pub fn probe(&mut self) -> Result<(), SessionError> {
        let started = Instant::now();
        let moment = self.history.current_mut().ok_or(SessionError::NoInput)?;
        let first = moment.belief.is_none();
        if let (Some(forecast), true) = (&moment.forecast, first) {
            let (mixture, draws) = (forecast.mixture.clone(), forecast.draws.clone());
            moment.belief = Some(self.models.probe.step(mixture, draws, moment.path_probability));
        }
        find(&mut self.models, moment);
        if first && moment.belief.is_some() {
            let steps: Vec<Step> = moment.steps().cloned().collect();
            let evidence = Evidence::of_steps(&steps);
            let decided = self.models.policy.decide(&evidence);
            self.journal.decided(Decision {
                rests_on: format!("{}, {}", moment.input.title, steps_ahead(moment.step)),
                halt: decided.halt,
                confidence: decided.confidence as f32,
                hazard_probability: evidence.hazard_probability() as f32,
                reason: self.models.policy.rule.name().to_owned(),
                latency_ms: None,
            });
        }
        self.journal.took_next("prober", ms(started));
        Ok(())
    }

    /// Whether [`Session::probe_and_predict`] would come to a step, or why not. What the scene shows is not known yet.
    pub fn can_advance(&self) -> Result<(), SessionError> {
        self.can_forecast(self.current()?.step + 1)
    }

    /// **Probe and predict**: probes the shown scene, and forecasts the next step from the posterior of the state that
    /// it shows.
    pub fn probe_and_predict(&mut self) -> Result<(), SessionError> {
        self.can_advance()?;
        self.probe()?;
        let moment = self.current()?.clone();
        let reading = &moment.found.as_ref().ok_or(SessionError::NoScene)?.probed.reading;
        let state = reading.state.ok_or(SessionError::Unknown)?;
        let source = *self.models.probe.state_posterior(state).ok_or(SessionError::Unknown)?;
        // The path goes on by the state that was chosen, which need not be the most probable one.
        let resolved = match &moment.belief {
            Some(belief) => Resolved { state, ..belief.resolved.clone() },
            None => Resolved {
                state,
                state_probabilities: reading.state_probabilities.clone(),
                hazard_probability: reading.hazard_likelihood,
            },
        };
        let path_probability = path_probability(moment.path_probability, resolved.state_probability(state));
        let step = moment.step + 1;
        let forecast = self.forecast(&source, &moment.input, step)?;
        let path = moment.steps().cloned().collect();
        let before = Moment { source, source_state: Some(state), path_probability, path, ..moment };
        self.history.push(Moment::of_forecast(&before, step, forecast));
        Ok(())
    }

    /// Shows another scene of the same step; where the step has been probed, the scene is, too.
    pub fn select(&mut self, selection: Selection) -> Result<(), SessionError> {
        let moment = self.history.current_mut().ok_or(SessionError::NoInput)?;
        latent(&self.models, moment, selection).ok_or(SessionError::NoScene)?;
        (moment.selection, moment.is_chosen) = (selection, true);
        if moment.belief.is_some() || moment.found.is_some() {
            find(&mut self.models, moment);
        }
        Ok(())
    }

    /// Goes back in the history; false at its beginning.
    pub fn back(&mut self) -> bool {
        self.history.back()
    }

    /// Goes forward in the history; false at its end.
    pub fn forward(&mut self) -> bool {
        self.history.forward()
    }

    /// Goes to an entry of the history; false when there is none.
    pub fn go_to(&mut self, place: usize) -> bool {
        self.history.go_to(place)
    }

    /// Shows what a running graph made of a frame, in place of all else: the same step as before, and the scene that
    /// was chosen, as far as it is there. Where none was chosen the component is kept as long as it weighs at least
    /// half as much as the heaviest: two that weigh about the same would take turns.
    pub fn follow(&mut self, mut moments: Vec<Moment>) {
        let first = self.history.entries().is_empty();
        for (moment, before) in moments.iter_mut().zip(self.history.entries()) {
            let weight = |selection| match (selection, &moment.forecast) {
                (Selection::Component(i), Some(forecast)) => forecast.mixture.weights.get(i).copied().unwrap_or(0.0),
                _ => 0.0,
            };
            let is_heavy = 2.0 * weight(before.selection) >= weight(moment.selection);
            let is_there = latent(&self.models, moment, before.selection).is_some();
            if is_there && (before.is_chosen || is_heavy) {
                (moment.selection, moment.is_chosen) = (before.selection, before.is_chosen);
            }
        }
        for moment in &mut moments {
            if moment.belief.is_some() {
                find(&mut self.models, moment);
            }
        }
        self.history.replace(moments);
        if first {
            self.history.go_to(1);
        }
    }

    /// The scene that is shown.
    pub fn shown(&self) -> Option<Scene> {
        let moment = self.moment()?;
        let mut scene = self.scene(moment, moment.selection)?;
        scene.probed = scene.probed.or_else(|| moment.found.as_ref().map(|f| f.probed.clone()));
        Some(scene)
    }

    /// The scenes to choose from: what was forecast from, the components, the samples.
    pub fn scenes(&self) -> Vec<Scene> {
        let Some(moment) = self.moment() else { return Vec::new() };
        let (components, samples) =
            moment.forecast.as_ref().map_or((0, 0), |f| (f.mixture.components.len(), f.draws.len()));
        std::iter::once(Selection::Source)
            .chain((0..components).map(Selection::Component))
            .chain((0..samples).map(Selection::Sample))
            .filter_map(|selection| self.scene(moment, selection))
            .collect()
    }

    fn scene(&self, moment: &Moment, selection: Selection) -> Option<Scene> {
        let latent = latent(&self.models, moment, selection)?;
        let belief = moment.belief.as_ref();
        let (name, probed, share) = match selection {
            Selection::Source => {
                let name = match moment.source_state {
                    Some(state) => format!("from {}", self.models.state_name(Some(state))),
                    None => "posterior".to_owned(),
                };
                (name, None, None)
            }
            Selection::Component(i) => {
                let weight = moment.forecast.as_ref().and_then(|f| f.mixture.weights.get(i).copied());
                (format!("component {}", i + 1), belief.and_then(|b| b.components.get(i).cloned()), weight)
            }
            Selection::Sample(i) => (format!("sample {}", i + 1), belief.and_then(|b| b.samples.get(i).cloned()), None),
            Selection::State(state) => (format!("state {}", self.models.state_name(Some(state))), None, None),
        };
        Some(Scene { selection, latent, name, probed, share })
    }
}

/// The latent of a scene; `None` when there is no such scene.
fn latent(models: &Models, moment: &Moment, selection: Selection) -> Option<[f32; LATENT_DIM]> {
    let forecast = moment.forecast.as_ref();
    match selection {
        Selection::Source => Some(moment.source.mean),
        Selection::Component(i) => forecast?.mixture.components.get(i).map(|c| c.mean),
        Selection::Sample(i) => forecast?.draws.get(i).map(|d| d.latent),
        Selection::State(state) => models.probe.state_posterior(state).map(|g| g.mean),
    }
}

/// Fills in what probing the shown scene finds. What was probed with the others is not probed again.
fn find(models: &mut Models, moment: &mut Moment) {
    let Some(latent) = latent(models, moment, moment.selection) else {
        moment.found = None;
        return;
    };
    let known = moment.belief.as_ref().and_then(|belief| match moment.selection {
        Selection::Component(i) => belief.components.get(i).cloned(),
        Selection::Sample(i) => belief.samples.get(i).cloned(),
        _ => None,
    });
    let probed = known.unwrap_or_else(|| models.probe.probe(&latent));
    let points = models.probe.layout().points();
    let mut densities = vec![0.0; points.len()];
    models.probe.field().density(points, &latent, &mut densities);
    moment.found = Some(Found { probed, densities });
}

/// "now", "1 step ahead", "2 steps ahead".
pub fn steps_ahead(step: u32) -> String {
    match step {
        0 => "now".to_owned(),
        1 => "1 step ahead".to_owned(),
        n => format!("{n} steps ahead"),
    }
}

fn ms(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}
