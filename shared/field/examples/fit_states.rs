//! Trains a field on a posed image dataset with one fixed random latent for each state, and prints its image quality.
//!
//! ```text
//! cargo run --release -p carff-field --example fit_states -- DATASET --out DIR [--seconds 300] [--rays 4096]
//! ```

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail};
use carff_base::geometry::PinholeCamera;
use carff_field::{
    Field, FieldConfig, FieldTrainer, LATENT_DIM, RayBatch, RaySampler, RenderBuffer, RenderOptions, TrainerConfig,
    TrainingView, changed_pixels,
};
use serde_json::Value;

struct PosedImage {
    camera: PinholeCamera,
    state: usize,
    view: usize,
    rgb: Vec<u8>,
}

struct Dataset {
    images: Vec<PosedImage>,
    states: usize,
    bev_view: usize,
    bounds_m: [[f32; 3]; 2],
}

fn load(dir: &Path) -> Result<Dataset> {
    let text = std::fs::read_to_string(dir.join("transforms.json")).context("reading transforms.json")?;
    let json: Value = serde_json::from_str(&text)?;
    let number = |frame: &Value, key: &str| {
        frame[key].as_f64().or(json[key].as_f64()).with_context(|| format!("`{key}` is missing"))
    };
    let mut images = Vec::new();
    for frame in json["frames"].as_array().context("`frames`")? {
        let file = dir.join(frame["file_path"].as_str().context("`file_path`")?);
        let image = image::open(&file).with_context(|| format!("{}", file.display()))?.to_rgb8();
        let m: [[f64; 4]; 4] = serde_json::from_value(frame["transform_matrix"].clone())?;
        let camera = PinholeCamera {
            width_px: image.width(),
            height_px: image.height(),
            fl_x_px: number(frame, "fl_x")?,
            fl_y_px: number(frame, "fl_y")?,
            cx_px: number(frame, "cx")?,
            cy_px: number(frame, "cy")?,
            world_from_camera: m,
        };
        camera.validate()?;
        images.push(PosedImage {
            camera,
            state: frame["scene_id"].as_u64().unwrap_or(0) as usize,
            view: frame["view_id"].as_u64().context("`view_id`")? as usize,
            rgb: image.into_raw(),
        });
    }
    let bounds: [[f32; 3]; 2] = serde_json::from_value(json["scenario"]["bounds"].clone())?;
    let states = images.iter().map(|p| p.state).max().unwrap_or(0) + 1;
    let bev_view = json["scenario"]["bev_view"].as_u64().unwrap_or(0) as usize;
    Ok(Dataset { images, states, bev_view, bounds_m: bounds })
}

/// Standard normal numbers by the sum of twelve uniform ones.
fn normals(seed: u64) -> [f32; LATENT_DIM] {
    let mut x = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    std::array::from_fn(|_| {
        (0..12)
            .map(|_| {
                x ^= x << 13;
                x ^= x >> 7;
                x ^= x << 17;
                (x >> 40) as f32 / 16_777_216.0
            })
            .sum::<f32>()
            - 6.0
    })
}

fn squared_error(rendered: &[f32], image: &[u8], pixels: Option<&[u32]>) -> (f64, usize) {
    let error = |i: usize| f64::from(rendered[i].clamp(0.0, 1.0) - f32::from(image[i]) / 255.0).powi(2);
    match pixels {
        None => ((0..image.len()).map(error).sum(), image.len()),
        Some(p) => (p.iter().flat_map(|p| (0..3).map(move |c| *p as usize * 3 + c)).map(error).sum(), p.len() * 3),
    }
}

fn psnr((sum, count): (f64, usize)) -> f64 {
    -10.0 * (sum / count.max(1) as f64).max(1e-12).log10()
}

fn save_png(path: &Path, rgb: &[f32], width: u32, height: u32) -> Result<()> {
    let bytes = rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect();
    image::RgbImage::from_raw(width, height, bytes).context("image size")?.save(path)?;
    Ok(())
}

/// Processor seconds that this program has used, all threads together (Linux; 0 elsewhere).
fn cpu_seconds() -> f64 {
    let Ok(stat) = std::fs::read_to_string("/proc/self/stat") else { return 0.0 };
    let ticks: f64 = stat.split(' ').skip(13).take(2).filter_map(|v| v.parse::<f64>().ok()).sum();
    ticks / 100.0
}

struct Score {
    matching: f64,
    unmatching: f64,
    changed: f64,
    other: f64,
}

fn evaluate(
    set: &Dataset,
    views: &[TrainingView],
    field: &Field,
    codes: &[[f32; LATENT_DIM]],
    out: Option<&Path>,
) -> Result<Score> {
    let options = RenderOptions { threads: 2, ..RenderOptions::default() };
    let mut buffer = RenderBuffer::new();
    let (mut matching, mut unmatching, mut changed, mut other) = ((0.0, 0), (0.0, 0), (0.0, 0), (0.0, 0));
    let add = |total: &mut (f64, usize), part: (f64, usize)| {
        total.0 += part.0;
        total.1 += part.1;
    };
    let mut strip: Vec<f32> = Vec::new();
    for (i, p) in set.images.iter().enumerate() {
        let is_bev = p.view == set.bev_view;
        // The bird's eye view and a tenth of the other views.
        if !is_bev && (p.view % 10 != 4 || out.is_none()) {
            continue;
        }
        field.render(&p.camera, &codes[p.state], &options, &mut buffer);
        if let Some(dir) = out {
            let name = format!("view{:03}_state{}.png", p.view, p.state);
            let mut both = Vec::new();
            let w = p.camera.width_px as usize * 3;
            for (r, t) in buffer.rgb.chunks(w).zip(p.rgb.chunks(w)) {
                both.extend_from_slice(r);
                both.extend(t.iter().map(|v| f32::from(*v) / 255.0));
            }
            if is_bev {
                strip.extend(&both);
            }
            save_png(&dir.join(name), &both, p.camera.width_px * 2, p.camera.height_px)?;
        }
        if !is_bev {
            add(&mut other, squared_error(&buffer.rgb, &p.rgb, None));
            continue;
        }
        add(&mut matching, squared_error(&buffer.rgb, &p.rgb, None));
        add(&mut changed, squared_error(&buffer.rgb, &p.rgb, Some(&views[i].changed)));
        for q in set.images.iter().filter(|q| q.view == set.bev_view && q.state != p.state) {
            add(&mut unmatching, squared_error(&buffer.rgb, &q.rgb, None));
        }
    }
    if let (Some(dir), Some(p)) = (out, set.images.first()) {
        let width = p.camera.width_px * 2;
        save_png(&dir.join("bev.png"), &strip, width, strip.len() as u32 / 3 / width)?;
    }
    Ok(Score { matching: psnr(matching), unmatching: psnr(unmatching), changed: psnr(changed), other: psnr(other) })
}

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let mut dataset = None;
    let mut out = PathBuf::from("fit_states_out");
    let (mut seconds, mut rays, mut latent_noise, mut every) = (300.0_f64, 4096_usize, 0.0_f32, 20.0_f64);
    let mut changed_share = 0.34_f32;
    let mut field_config = FieldConfig::default();
    let mut config = TrainerConfig::default();
    let mut it = arguments.iter();
    while let Some(a) = it.next() {
        let mut value = || it.next().with_context(|| format!("{a} needs a value"));
        match a.as_str() {
            "--out" => out = PathBuf::from(value()?),
            "--seconds" => seconds = value()?.parse()?,
            "--every" => every = value()?.parse()?,
            "--rays" => rays = value()?.parse()?,
            "--latent-noise" => latent_noise = value()?.parse()?,
            "--changed-share" => changed_share = value()?.parse()?,
            // Any value of the two configurations, as JSON: --field '{"levels": 6}' --trainer '{"steps": 1000}'.
            "--field" => field_config = serde_json::from_str(value()?)?,
            "--trainer" => config = serde_json::from_str(value()?)?,
            name if !name.starts_with("--") => dataset = Some(PathBuf::from(name)),
            other => bail!("unknown option {other}"),
        }
    }
    let set = load(&dataset.context("which dataset?")?)?;
    field_config.bounds_m = set.bounds_m;
    std::fs::create_dir_all(&out)?;

    let views: Vec<TrainingView> = set
        .images
        .iter()
        .map(|p| {
            let same: Vec<&[u8]> = set.images.iter().filter(|q| q.view == p.view).map(|q| &q.rgb[..]).collect();
            TrainingView { camera: p.camera, rgb: p.rgb.clone(), changed: changed_pixels(&same, 12), valid: Vec::new() }
        })
        .collect();
    let codes: Vec<[f32; LATENT_DIM]> = (0..set.states).map(|s| normals(100 + s as u64)).collect();
    let noise = latent_noise * 4.0;
    let jittered = |state: usize, draw: u64| -> [f32; LATENT_DIM] {
        let n = normals(draw);
        // Two independent unit normal 8-d codes are 4 apart on average; the noise is a share of that, over 8 numbers.
        std::array::from_fn(|k| codes[state][k] + noise / (LATENT_DIM as f32).sqrt() * n[k])
    };
    let posteriors: Vec<Vec<[f32; LATENT_DIM]>> = (0..set.states)
        .map(|s| std::iter::once(codes[s]).chain((1..16).map(|i| jittered(s, (s * 100 + i) as u64))).collect())
        .collect();

    let field = Field::new(field_config, config.seed)?;
    println!("{} numbers, {}", field.parameter_count(), field.instruction_set().name());
    let mut trainer = FieldTrainer::new(field, config)?;
    trainer.set_state_latents(&posteriors);
    let mut sampler = RaySampler::new(views.clone(), changed_share, 1);
    let mut batch = RayBatch::default();
    let (mut cpu, mut spent, mut next, mut total_rays, mut psnr_mean) = (0.0, 0.0, every, 0_usize, 0.0);
    while cpu < seconds * 2.0 && trainer.step_count() < 10_000_000 {
        let (t, c) = (Instant::now(), cpu_seconds());
        sampler.next_batch(rays, &mut batch, |v, draw| jittered(set.images[v].state, draw));
        let report = trainer.step(&batch);
        spent += t.elapsed().as_secs_f64();
        cpu += cpu_seconds() - c;
        total_rays += report.rays;
        psnr_mean += 0.02 * (report.psnr - psnr_mean);
        if trainer.step_count() % 250 == 1 {
            println!(
                "  {cpu:.1} cpu s: step {} {} rays {} samples {} kept, scale {:.2}, loss {:.5}",
                trainer.step_count(),
                report.rays,
                report.samples,
                report.kept_samples,
                trainer.step_scale(),
                report.loss
            );
        }
        if cpu >= next * 2.0 || cpu >= seconds * 2.0 {
            next += every;
            let t = Instant::now();
            let s = evaluate(&set, &views, trainer.field(), &codes, None)?;
            println!(
                "{spent:5.0} s, {cpu:5.0} cpu s: step {:6} {:6.2} M rays ({:.0}/cpu s) samples/ray {:.1} kept {:.1} occupied {:.3} lr {:.3} train {psnr_mean:.2} | bev {:.2} unmatching {:.2} changed {:.2} others {:.2} dB (evaluated in {:.1} s)",
                trainer.step_count(),
                total_rays as f64 / 1e6,
                total_rays as f64 / cpu,
                report.samples as f64 / report.rays as f64,
                report.kept_samples as f64 / report.rays as f64,
                trainer.field().occupancy().occupied_share(),
                trainer.learning_rate_factor(),
                s.matching,
                s.unmatching,
                s.changed,
                s.other,
                t.elapsed().as_secs_f64(),
            );
        }
    }
    let mut field = trainer.into_field();
    let s = evaluate(&set, &views, &field, &codes, Some(&out))?;
    field.round_to_f16();
    let half = evaluate(&set, &views, &field, &codes, None)?;
    println!(
        "final: bev {:.2} unmatching {:.2} changed {:.2} others {:.2} dB; in f16: bev {:.2} changed {:.2} others {:.2}",
        s.matching, s.unmatching, s.changed, s.other, half.matching, half.changed, half.other
    );
    let bev = set.images.iter().find(|p| p.view == set.bev_view).context("bird's eye view")?;
    let mut buffer = RenderBuffer::new();
    for threads in [1, 2] {
        let options = RenderOptions { threads, ..RenderOptions::default() };
        let t = Instant::now();
        for code in codes.iter().cycle().take(12) {
            field.render(&bev.camera, code, &options, &mut buffer);
        }
        println!("bird's eye, {threads} threads: {:.1} ms", t.elapsed().as_secs_f64() / 12.0 * 1e3);
    }
    Ok(())
}
