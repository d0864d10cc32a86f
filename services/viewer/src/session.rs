//! The logic of the window, without a window: an image, the scenes that explain it, and their forecasts.
//!
//! - *Toggle* computes an image's posterior.
//! - *Predict* forecasts one step: a mixture, and latents drawn from it.
//! - *Probe and predict* probes the shown scene, resolves it to a known state, and forecasts from that state's
//!   posterior, up to the horizon.
//!
//! The session calls the same functions as the stages.

use crate::history::History;
use crate::input::ChosenImage;
use crate::journal::{Journal, ShownDecision};
use crate::models::SessionModels;
use carff_decision::{Draw, Evidence, Mixture, Probed, Resolved, Sampling, Step, path_probability};
use carff_messages::{ActionCode, Gaussian, LATENT_DIM, MAX_HORIZON, MAX_SAMPLES, UnknownBox};
use std::sync::Arc;
use std::time::Instant;

/// Settings of the look-ahead.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionSettings {
    /// Number of latents drawn per step, 1..=64.
    pub samples: usize,
    /// Distribution of the draws over the components.
    pub sampling: Sampling,
    /// Maximum number of look-ahead steps, 1..=8.
    pub horizon: u32,
    /// Seed of the draws.
    pub seed: u64,
}

/// The shown scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Selection {
    /// The scene of the forecast's input: the image's posterior, or the state that was fed back.
    Source,
    /// The scene of a mixture component's mean.
    Component(usize),
    /// The scene of a drawn latent.
    Sample(usize),
    /// The scene of a known state.
    State(usize),
}

/// The result of probing the shown scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// Occupancy of each place, and the state that they match.
    pub probed: Probed,
    /// Density at each of the prober's points, 1/m.
    pub densities: Vec<f32>,
}

/// A forecast: the mixture over the next latent, and its samples.
#[derive(Clone, Debug, PartialEq)]
pub struct ShownForecast {
    /// The mixture.
    pub mixture: Mixture,
    /// The drawn latents.
    pub draws: Vec<Draw>,
}

/// An entry of the history: an input with its forecast and belief so far.
#[derive(Clone, Debug)]
pub struct Moment {
    /// The input image.
    pub input: Arc<ChosenImage>,
    /// Boxes in which a running graph's prober finds what no known state explains.
    pub unknowns: Arc<[UnknownBox]>,
    /// Number of steps after the image.
    pub step: u32,
    /// Input of the forecast: the image's posterior, or that of a known state.
    pub source: Gaussian,
    /// The known state; `None` for an image's posterior.
    pub source_state: Option<usize>,
    /// The forecast; `None` at step 0.
    pub forecast: Option<ShownForecast>,
    /// The belief from all scenes of the forecast; `None` before it is probed.
    pub belief: Option<Step>,
    /// The shown scene.
    pub selection: Selection,
    /// True if the user chose the scene.
    pub is_chosen: bool,
    /// Result of probing the shown scene; `None` before it is probed.
    pub found: Option<Found>,
    /// Probability of the path up to this step.
    pub path_probability: f32,
    /// The earlier probed steps of this path.
    pub path: Vec<Step>,
}

impl Moment {
    /// Returns a moment with only an image's posterior.
    pub fn of_posterior(input: Arc<ChosenImage>, posterior: Gaussian) -> Self {
        Self {
            input,
            unknowns: Arc::default(),
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

    /// Returns a moment with a forecast's scenes; it shows the most probable component.
    pub fn of_forecast(before: &Self, step: u32, forecast: ShownForecast) -> Self {
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

    /// Returns the probed steps up to this one.
    pub fn steps(&self) -> impl Iterator<Item = &Step> {
        self.path.iter().chain(&self.belief)
    }
}

/// A scene that can be shown.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Key of the scene.
    pub selection: Selection,
    /// Latent of the scene.
    pub latent: [f32; LATENT_DIM],
    /// Name of the scene.
    pub name: String,
    /// Result of probing, if the scene has been probed.
    pub probed: Option<Probed>,
    /// The scene's share of the forecast, 0..=1.
    pub share: Option<f32>,
}

/// Reason why a command is not possible.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SessionError {
    /// No image has been toggled yet.
    #[error("no image yet: choose one, and press Toggle")]
    NoInput,
    /// The encoder refused the image.
    #[error("the encoder cannot read `{title}`: {width_px} x {height_px} pixels")]
    Image {
        /// Name of the image.
        title: String,
        /// Width of the image, pixels.
        width_px: u32,
        /// Height of the image, pixels.
        height_px: u32,
    },
    /// The checkpoint cannot forecast.
    #[error("{0}")]
    NoMixture(String),
    /// The shown scene matches no known state.
    #[error("the shown scene matches no known state, so it cannot be forecast: choose another one")]
    Unknown,
    /// The horizon is reached.
    #[error("step {step} is the last of the horizon: go back, or set a longer horizon")]
    Horizon {
        /// The shown step.
        step: u32,
    },
    /// The scene does not exist.
    #[error("there is no such scene to show: forecast first")]
    NoScene,
}

/// The models, the history, and the journal.
pub struct Session {
    models: SessionModels,
    history: History<Moment>,
    settings: SessionSettings,
    /// Decisions and durations.
    pub journal: Journal,
}

impl Session {
    /// Creates a session without an image.
    pub fn new(models: SessionModels) -> Self {
        let settings = SessionSettings {
            samples: 10,
            sampling: Sampling::Stratified,
            horizon: models.trained.calibration.horizon.clamp(2, MAX_HORIZON),
            seed: 1,
        };
        Self { models, history: History::default(), settings, journal: Journal::default() }
    }

    /// Returns the models.
    pub fn models(&self) -> &SessionModels {
        &self.models
    }

    /// Returns the settings.
    pub fn settings(&self) -> SessionSettings {
        self.settings
    }

    /// Sets the settings within their limits; they apply to later forecasts.
    pub fn set_settings(&mut self, settings: SessionSettings) {
        self.settings = SessionSettings {
            samples: settings.samples.clamp(1, MAX_SAMPLES),
            horizon: settings.horizon.clamp(1, MAX_HORIZON),
            ..settings
        };
    }

    /// Returns the history of moments.
    pub fn history(&self) -> &History<Moment> {
        &self.history
    }

    /// Returns the current moment.
    pub fn moment(&self) -> Option<&Moment> {
        self.history.current()
    }

    fn current(&self) -> Result<&Moment, SessionError> {
        self.moment().ok_or(SessionError::NoInput)
    }

    /// **Toggle**: shows the scene of an image's posterior.
    pub fn toggle(&mut self, input: Arc<ChosenImage>) -> Result<(), SessionError> {
        let started = Instant::now();
        let Some(posterior) = self.models.encode(&input.image) else {
            let (width_px, height_px) = (input.image.width_px, input.image.height_px);
            return Err(SessionError::Image { title: input.title.clone(), width_px, height_px });
        };
        self.journal.took_next("encoder", ms(started));
        let moment = Moment::of_posterior(input, posterior);
        let is_last = !self.history.has_forward();
        match self.history.current_mut() {
            // Browsing through images adds no entries.
            Some(shown) if is_last && shown.step == 0 && shown.found.is_none() => *shown = moment,
            _ => self.history.push(moment),
        }
        Ok(())
    }

    /// Returns an error if [`Session::predict`] is not possible, with the reason.
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

    /// **Predict**: forecasts the mixture one step after the image and draws latents from it. If the step is already
    /// shown, its latents are drawn again with the current settings.
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

    /// Returns one step's forecast, as the forecaster stage computes it for the same frame number.
    fn forecast(&mut self, source: &Gaussian, input: &ChosenImage, step: u32) -> Result<ShownForecast, SessionError> {
        let started = Instant::now();
        let net = self.models.mixture.as_ref().map_err(|why| SessionError::NoMixture(why.clone()))?;
        let mixture = net.forecast(source);
        let SessionSettings { samples, sampling, seed, .. } = self.settings;
        let draws = mixture.draw(samples, sampling, input.seed.unwrap_or(seed), input.frame, step);
        self.journal.took_next("forecaster", ms(started));
        Ok(ShownForecast { mixture, draws })
    }

    /// **Probe**: probes the shown scene and, in a forecast, all others; the result is the belief.
    pub fn probe(&mut self) -> Result<(), SessionError> {
        let started = Instant::now();
        let moment = self.history.current_mut().ok_or(SessionError::NoInput)?;
        let first = moment.belief.is_none();
        if let (Some(forecast), true) = (&moment.forecast, first) {
            let (mixture, draws) = (forecast.mixture.clone(), forecast.draws.clone());
            moment.belief = Some(self.models.probe.step(mixture, draws, moment.path_probability, None));
        }
        find(&mut self.models, moment);
        if first && moment.belief.is_some() {
            let steps: Vec<Step> = moment.steps().cloned().collect();
            let evidence = Evidence::of_steps(&steps);
            let decided = self.models.policy.decide(&evidence);
            self.journal.decided(ShownDecision {
                rests_on: format!("{}, {}", moment.input.title, steps_ahead(moment.step)),
                action: if decided.halt { ActionCode::Halt } else { ActionCode::Advance },
                confidence: decided.confidence as f32,
                hazard_probability: evidence.hazard_probability() as f32,
                reason: self.models.policy.rule.name().to_owned(),
                latency_ms: None,
            });
        }
        self.journal.took_next("prober", ms(started));
        Ok(())
    }

    /// Returns an error if [`Session::probe_and_predict`] is not possible. The state of the scene is not known yet.
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
        // The path continues from the chosen state, which may differ from the most probable one.
        let resolved = match &moment.belief {
            Some(belief) => Resolved { state, ..belief.resolved.clone() },
            None => Resolved {
                state,
                state_probabilities: reading.state_probabilities.clone(),
                unknown_probability: 0.0,
                hazard_probability: reading.hazard_likelihood,
            },
        };
        let layout = self.models.probe.layout();
        let path_probability = path_probability(moment.path_probability, layout, &resolved.state_probabilities, state);
        let step = moment.step + 1;
        let forecast = self.forecast(&source, &moment.input, step)?;
        let path = moment.steps().cloned().collect();
        let before = Moment { source, source_state: Some(state), path_probability, path, ..moment };
        self.history.push(Moment::of_forecast(&before, step, forecast));
        Ok(())
    }

    /// Shows another scene of the same step; if the step has been probed, the scene is probed, too.
    pub fn select(&mut self, selection: Selection) -> Result<(), SessionError> {
        let moment = self.history.current_mut().ok_or(SessionError::NoInput)?;
        latent(&self.models, moment, selection).ok_or(SessionError::NoScene)?;
        (moment.selection, moment.is_chosen) = (selection, true);
        if moment.belief.is_some() || moment.found.is_some() {
            find(&mut self.models, moment);
        }
        Ok(())
    }

    /// Goes back in the history; returns false at its beginning.
    pub fn back(&mut self) -> bool {
        self.history.back()
    }

    /// Goes forward in the history; returns false at its end.
    pub fn forward(&mut self) -> bool {
        self.history.forward()
    }

    /// Goes to an entry of the history; returns false if there is none.
    pub fn go_to(&mut self, place: usize) -> bool {
        self.history.go_to(place)
    }

    /// Shows a running graph's moments of a frame in place of all entries. The step and the chosen scene stay if they
    /// exist. Without a choice, a component stays while its weight is at least half of the largest weight; otherwise
    /// two components of similar weight would alternate.
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

    /// Returns the shown scene.
    pub fn shown(&self) -> Option<Scene> {
        let moment = self.moment()?;
        let mut scene = self.scene(moment, moment.selection)?;
        scene.probed = scene.probed.or_else(|| moment.found.as_ref().map(|f| f.probed.clone()));
        Some(scene)
    }

    /// Returns the scenes that can be shown: the forecast's input, the components, and the samples.
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

/// Returns the latent of a scene; `None` if the scene does not exist.
fn latent(models: &SessionModels, moment: &Moment, selection: Selection) -> Option<[f32; LATENT_DIM]> {
    let forecast = moment.forecast.as_ref();
    match selection {
        Selection::Source => Some(moment.source.mean),
        Selection::Component(i) => forecast?.mixture.components.get(i).map(|c| c.mean),
        Selection::Sample(i) => forecast?.draws.get(i).map(|d| d.latent),
        Selection::State(state) => models.probe.state_posterior(state).map(|g| g.mean),
    }
}

/// Probes the shown scene, unless it has been probed with the others.
fn find(models: &mut SessionModels, moment: &mut Moment) {
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

/// Formats a step: "now", "1 step ahead", "2 steps ahead".
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
