//! Renders a free drive into a folder of PNG files on one thread, and prints time and visibility of each frame.
//!
//! ```text
//! cargo run --release -p carff-scenes --example free_drive -- SCENARIO.toml NUMBER SEED OUT_DIR
//! ```

use std::path::PathBuf;
use std::time::Instant;

use carff_scenes::Scenario;

/// Frames of each time step.
const FRAMES: usize = 6;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scenario, number, seed, out] = arguments.as_slice() else {
        return Err("usage: free_drive SCENARIO.toml NUMBER SEED OUT_DIR".into());
    };
    let out = PathBuf::from(out);
    std::fs::create_dir_all(&out)?;
    let scenario = Scenario::load(scenario.as_ref())?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let begin = Instant::now();
    let (number, seed) = (number.parse()?, seed.parse()?);
    let drive = pool.install(|| scenario.free_drive(number, FRAMES, seed))?;
    println!(
        "{} drive, {} camera, planned in {:.0} ms; its decision counts at frame {}",
        drive.kind().name(),
        drive.view_kind(),
        begin.elapsed().as_secs_f64() * 1e3,
        drive.decisive_frame()
    );
    for frame in 0..drive.frame_count() {
        let begin = Instant::now();
        let shown = pool.install(|| scenario.free_frame(&drive, frame))?;
        let seen = shown.observability.map_or("no actor", |o| o.name());
        println!("frame {frame:>3}  t{}  {seen:<8} {:>6.1} ms", shown.timestamp, begin.elapsed().as_secs_f64() * 1e3);
        shown.image.save_png(&out.join(format!("{frame:03}.png")))?;
    }
    Ok(())
}
