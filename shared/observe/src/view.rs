//! Arguments of the live window, which `carff view` and the window's program share.

use clap::{Args, ValueEnum, ValueHint};
use std::path::PathBuf;

/// Open the live window.
#[derive(Clone, Debug, Args)]
pub struct ViewArgs {
    /// Folder of the trained models. Default: the models of the run, or the shipped ones.
    #[arg(long, value_hint = ValueHint::DirPath)]
    pub checkpoint: Option<PathBuf>,
    /// Folder of the dataset to choose images from. Default: the dataset that the models were trained on, if it exists.
    #[arg(long, value_hint = ValueHint::DirPath)]
    pub dataset: Option<PathBuf>,
    /// Watch a running graph: the one of this name, or, without a name, the only one.
    #[arg(long, num_args = 0..=1, default_missing_value = "", value_name = "NAME", value_hint = ValueHint::Other)]
    pub run: Option<String>,
    /// A PNG image to start with.
    #[arg(long, value_name = "FILE", conflicts_with = "run")]
    pub image: Option<PathBuf>,
    /// Command to run first; can be given several times.
    #[arg(long = "do", value_name = "WHAT")]
    pub first: Vec<First>,
    /// Threads for drawing. Default: the number of cores; one while a run is watched.
    #[arg(long)]
    pub threads: Option<usize>,
    /// Colours of the window. Default: the system's preference.
    #[arg(long)]
    pub theme: Option<Theme>,
    /// Folder for screenshots.
    #[arg(long, default_value = ".", value_hint = ValueHint::DirPath)]
    pub folder: PathBuf,
    /// Save the window as this PNG file when everything is drawn, and exit.
    #[arg(long, value_name = "FILE")]
    pub screenshot: Option<PathBuf>,
    /// With --screenshot: wait at least this many seconds.
    #[arg(long, default_value_t = 0.0, requires = "screenshot")]
    pub after: f32,
    /// Size of the window, points.
    #[arg(long, num_args = 2, value_names = ["WIDTH", "HEIGHT"], default_values_t = [1440.0, 900.0])]
    pub size: Vec<f32>,
}

/// A command of the window to run first.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum First {
    /// Take the image as the input.
    Toggle,
    /// Forecast the input.
    Predict,
    /// Probe the forecast.
    Probe,
    /// Probe, then forecast from the resolved state.
    ProbeAndPredict,
}

/// Colours of the window.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum Theme {
    /// Light on dark.
    Dark,
    /// Dark on light.
    Light,
}
