//! Measures encoder and forecaster one frame at a time, as their stages run them.

use anyhow::Context;
use carff_bench::EncoderArgs;
use carff_bench::report::{Report, number, table};
use carff_bench::stats::{Contender, Ratio, Times, alternate, timed};
use carff_checkpoint::{
    Manifest,
    shapes::{BackboneConfig, BackboneKind, EncoderConfig},
};
use carff_decision::{Mixture, Sampling};
use carff_messages::Gaussian;
use carff_networks::{
    borrow,
    encoder::{Encoder, gaussians, images_from_bytes},
};
use ndarray::ArrayView3;
use tch::{Device, Kind, nn::VarStore};

/// Side of the measured image, pixels.
const SIDE_PX: usize = 128;
/// Latents drawn from a forecast.
const SAMPLES: usize = 10;

pub(crate) fn run(args: &EncoderArgs) -> anyhow::Result<Report> {
    carff_networks::allocator::keep_large_blocks();
    let manifest = Manifest::load(&args.checkpoint)?;
    let encoder = carff_networks::stored::load_encoder(&args.checkpoint, &manifest)?;
    let net = carff_networks::stored::load_mixture(&args.checkpoint, &manifest)?;
    let rgb: Vec<u8> = (0..SIDE_PX * SIDE_PX * 3).map(|i| ((i * 2_654_435_761) >> 13) as u8).collect();
    let posterior = encode(&encoder, &rgb).context("the encoder gives no posterior")?;

    let mut report = Report::default();
    let mut rows = vec![["a frame (ms)", "p50", "p99", "max", "frames"].map(str::to_owned)];
    let mut note = |name: &str, key: &str, seconds: &[f64]| {
        let times = Times::new(seconds.iter().map(|s| s * 1e3).collect());
        let [p50, p99, max] = [0.5, 0.99, 1.0].map(|q| times.quantile(q));
        rows.push([name.to_owned(), number(p50), number(p99), number(max), times.count().to_string()]);
        report.set(&format!("{key}p50_ms"), p50);
        report.set(&format!("{key}p99_ms"), p99);
    };

    let load = |threads| carff_inference::Encoder::load(&args.checkpoint, &manifest, threads);
    let (mut one, mut two) = (load(1)?, load(2)?);
    let seconds = alternate(
        if args.quick { 20 } else { 300 },
        &mut [in_onnx(&mut one, &rgb), in_tch(&encoder, &rgb, 1), in_onnx(&mut two, &rgb), in_tch(&encoder, &rgb, 2)],
    );
    let backbone = format!("{:?}", manifest.encoder.backbone.kind);
    for (seconds, (library, threads, key)) in seconds.iter().zip([
        ("ONNX Runtime", "1 thread", "encoder."),
        ("libtorch", "1 thread", "encoder.tch."),
        ("ONNX Runtime", "2 threads", "encoder.two_threads."),
        ("libtorch", "2 threads", "encoder.tch.two_threads."),
    ]) {
        note(&format!("encoder, {backbone}, {library}, {threads}"), key, seconds);
    }
    let gains = [Ratio::new(&seconds[1], &seconds[0]), Ratio::new(&seconds[3], &seconds[2])];

    let halved = in_bf16(args, &manifest, &encoder, &rgb)?;
    if let Some(halved) = &halved {
        note("encoder, backbone in bf16, 1 thread", "encoder.bf16.", &halved.seconds);
    }

    tch::set_num_threads(1);
    let native = carff_inference::MixtureNet::load(&args.checkpoint, &manifest)?;
    let draw = |mixture: Mixture| std::hint::black_box(mixture.draw(SAMPLES, Sampling::Stratified, 1, 2, 1));
    let seconds = alternate(
        if args.quick { 200 } else { 3000 },
        &mut [timed(|| drop(draw(native.forecast(&posterior)))), timed(|| drop(draw(net.forecast(&posterior))))],
    );
    note(&format!("forecaster, n = {SAMPLES}"), "forecaster.", &seconds[0]);
    note(&format!("forecaster, n = {SAMPLES}, libtorch, 1 thread"), "forecaster.tch.", &seconds[1]);
    let forecaster_gain = Ratio::new(&seconds[1], &seconds[0]);

    if !args.no_vit {
        let vit = random_vit()?;
        let seconds = alternate(if args.quick { 2 } else { 10 }, &mut [in_tch(&vit, &rgb, 1), in_tch(&vit, &rgb, 2)]);
        note("encoder, ViT-L/16 of random weights, libtorch, 1 thread", "encoder.vit_l16.", &seconds[0]);
        note("encoder, ViT-L/16 of random weights, libtorch, 2 threads", "encoder.vit_l16.two_threads.", &seconds[1]);
    }
    print!("{}", table(&rows));
    println!(
        "libtorch takes {} the time of ONNX Runtime on one thread and {} on two; {} that of the native forecaster",
        gains[0], gains[1], forecaster_gain
    );
    report.set("encoder.tch_vs_onnx", gains[0].of_medians);
    report.set("encoder.tch_vs_onnx.two_threads", gains[1].of_medians);
    report.set("forecaster.tch_vs_native", forecaster_gain.of_medians);
    if let Some(halved) = &halved {
        println!(
            "with the backbone in bf16 a frame is encoded {} as fast as in f32; this one's mean moves by {} of its \
             deviations",
            halved.ratio,
            number(halved.moved)
        );
        report.set("encoder.bf16.vs_f32", halved.ratio.of_medians);
        report.set("encoder.bf16.moves_mean_by_deviations", halved.moved);
    }
    Ok(report)
}

/// Returns the paper's encoder with random weights.
fn random_vit() -> anyhow::Result<Encoder> {
    let config = EncoderConfig {
        backbone: BackboneConfig { kind: BackboneKind::Vit, ..BackboneConfig::default() },
        ..EncoderConfig::default()
    };
    let store = VarStore::new(Device::Cpu);
    Ok(Encoder::new(&config, &(store.root() / "backbone"), &(store.root() / "head"), None)?)
}

/// The encoder with its backbone in bf16.
struct Halved {
    /// Time of each frame, seconds.
    seconds: Vec<f64>,
    /// Median time in f32 over median time in bf16.
    ratio: Ratio,
    /// Largest shift of a coordinate of the posterior's mean, in its standard deviations.
    moved: f64,
}

/// Measures a frozen backbone in bf16, with the head in f32, on one thread; `None` for a backbone that was trained.
fn in_bf16(args: &EncoderArgs, manifest: &Manifest, encoder: &Encoder, rgb: &[u8]) -> anyhow::Result<Option<Halved>> {
    let file = args.checkpoint.join(carff_checkpoint::files::BACKBONE);
    if !manifest.encoder.backbone.frozen || !file.is_file() {
        return Ok(None);
    }
    let (mut backbone, head) = (VarStore::new(Device::Cpu), VarStore::new(Device::Cpu));
    let halved = Encoder::new(&manifest.encoder, &(backbone.root() / "backbone"), &head.root(), Some(file.as_path()))?;
    backbone.set_kind(Kind::BFloat16);
    let encode_halved = || {
        borrow::with_image(image(rgb)?, |image| {
            let image = images_from_bytes(&image.unsqueeze(0)).to_kind(Kind::BFloat16);
            let (mean, log_variance) =
                tch::no_grad(|| encoder.posterior(&halved.features(&image).to_kind(Kind::Float), 0.0));
            gaussians(&mean, &log_variance)
        })
        .and_then(|all| all.into_iter().next())
    };
    let whole = encode(encoder, rgb).context("the encoder gives no posterior")?;
    let off = encode_halved().context("the encoder gives no posterior in bf16")?;
    let moved = (0..off.mean.len())
        .map(|k| f64::from((off.mean[k] - whole.mean[k]).abs() / (0.5 * whole.log_variance[k]).exp()))
        .fold(0.0, f64::max);
    tch::set_num_threads(1);
    let seconds = alternate(
        if args.quick { 20 } else { 100 },
        &mut [
            timed(|| {
                std::hint::black_box(encode(encoder, rgb));
            }),
            timed(|| {
                std::hint::black_box(encode_halved());
            }),
        ],
    );
    let ratio = Ratio::new(&seconds[0], &seconds[1]);
    Ok(seconds.into_iter().nth(1).map(|seconds| Halved { seconds, ratio, moved }))
}

/// Times the encoder as the stage runs it by default.
fn in_onnx<'a>(encoder: &'a mut carff_inference::Encoder, rgb: &'a [u8]) -> Contender<'a> {
    timed(move || {
        let _ = std::hint::black_box(image(rgb).map(|image| encoder.encode(image)));
    })
}

/// Times the encoder in libtorch. The change of threads is not part of the frame.
fn in_tch<'a>(encoder: &'a Encoder, rgb: &'a [u8], threads: i32) -> Contender<'a> {
    let mut clock = timed(move || {
        std::hint::black_box(encode(encoder, rgb));
    });
    Box::new(move || {
        tch::set_num_threads(threads);
        clock()
    })
}

/// Computes the posterior of an image's bytes in libtorch.
fn encode(encoder: &Encoder, rgb: &[u8]) -> Option<Gaussian> {
    borrow::with_image(image(rgb)?, |image| encoder.encode_bytes(image)).flatten()
}

fn image(rgb: &[u8]) -> Option<ArrayView3<'_, u8>> {
    ArrayView3::from_shape((SIDE_PX, SIDE_PX, 3), rgb).ok()
}
