//! Renders a scenario into a dataset, prints its statistics, and draws its contact sheet.
//!
//! ```text
//! cargo run --release -p carff-scenes --example render_scenario -- SCENARIO.toml OUT_DIR CONTACT_SHEET.png
//! ```

use std::ops::ControlFlow;
use std::path::PathBuf;

use carff_dataset::{Dataset, DatasetReport, SheetOptions, contact_sheet};
use carff_scenes::{Extras, Scenario};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let (Some(scenario), Some(out), Some(sheet)) = (arguments.next(), arguments.next(), arguments.next()) else {
        return Err("usage: render_scenario SCENARIO.toml OUT_DIR CONTACT_SHEET.png".into());
    };
    Scenario::load(&scenario)?.render_dataset(&out, Extras::None, |done, total| {
        if done.is_multiple_of(100) || done == total {
            println!("{done} of {total}");
        }
        ControlFlow::Continue(())
    })?;
    let dataset = Dataset::open(&out)?;
    let images = dataset.load_all_images()?;
    println!("{}", DatasetReport::of(&dataset, &images));
    contact_sheet(&dataset, &images, SheetOptions::default()).save_png(&sheet)?;
    Ok(())
}
