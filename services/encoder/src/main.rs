//! The encoder stage with ONNX Runtime: camera frames in, posteriors out.

use anyhow::Context;
use carff_checkpoint::Manifest;
use carff_inference::Encoder;
use carff_messages::Stage;
use carff_runtime::StageContext;

fn main() -> std::process::ExitCode {
    let silent = carff_inference::library::without_telemetry();
    carff_runtime::main(Stage::Encoder, |stage| {
        silent.context("the encoder cannot be started with the telemetry of ONNX Runtime off")?;
        carff_encoder::run(stage, load, |encoder, image| Ok(encoder.encode(image)?))
    })
}

fn load(stage: &StageContext) -> anyhow::Result<Encoder> {
    let manifest = Manifest::load(&stage.checkpoint)?;
    Ok(Encoder::load(&stage.checkpoint, &manifest, stage.threads)?)
}
