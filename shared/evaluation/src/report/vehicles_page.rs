//! The part of the page with vehicles on the others' lane. Writing into a `String` cannot fail, so results of `write!`
//! are dropped.

use super::{
    Results,
    markdown::{head, row},
};
use std::fmt::Write;

/// Writes the table of vehicles.
pub fn vehicles(page: &mut String, results: &Results) {
    let Some(table) = &results.vehicles else { return };
    let _ = writeln!(
        page,
        "## Vehicles on the lane\n\nThe image of a moving camera shows a vehicle at any place and speed. Errors are along the \
         lane. Images of one drive are not independent.\n"
    );
    head(page, &["vehicle", "images", "drives", "found", "RMSE, m", "bias, m", "median, m", "95th percentile, m"]);
    for (name, figures) in
        [("whole, near", &table.near), ("whole, beyond 12 m", &table.far), ("in part", &table.partial)]
    {
        let metres = [figures.rmse_m, figures.bias_m, figures.percentiles_m[0], figures.percentiles_m[1]];
        let counts = [figures.images, figures.drives, figures.found].map(|count| count.to_string());
        let numbers = metres.map(|m| format!("{m:.2}"));
        row(page, &[name.to_owned()].into_iter().chain(counts).chain(numbers).collect::<Vec<_>>());
    }
    let _ = writeln!(
        page,
        "\nVehicles in {} images that show none: {}. Speed of whole vehicles: RMSE {:.2} m/s in {} images.\n",
        table.empty_images, table.invented, table.speed_rmse_mps, table.speeds
    );
}
