//! The help window: keys and mouse actions.

use super::{WindowCommand, theme};
use eframe::egui::{Align2, Context, Grid, Window};

const MOUSE: [(&str, &str); 4] = [
    ("drag", "turn about the scene"),
    ("right drag, Shift+drag", "move along the image"),
    ("wheel, pinch", "nearer, farther"),
    ("drop a PNG file", "show the scene of that image"),
];

/// Shows the help; `is_open` becomes false when the user closes it.
pub fn show(ctx: &Context, is_open: &mut bool) {
    let palette = theme::palette(ctx);
    Window::new("Keys and mouse")
        .open(is_open)
        .collapsible(false)
        .resizable(false)
        .anchor(Align2::CENTER_CENTER, [0.0, 0.0])
        .show(ctx, |ui| {
            ui.spacing_mut().interact_size.y = 16.0;
            ui.horizontal_top(|ui| {
                let (left, right) = WindowCommand::ALL.split_at(WindowCommand::ALL.len() / 2);
                for (column, topics) in [left, right].into_iter().enumerate() {
                    Grid::new(("keys", column)).num_columns(2).spacing([18.0, 4.0]).show(ui, |ui| {
                        for (topic, commands) in topics {
                            ui.label(theme::strong(*topic).color(palette.accent));
                            ui.end_row();
                            for (_, modifiers, key, what) in *commands {
                                ui.monospace(WindowCommand::key_name(*modifiers, *key));
                                ui.label(*what);
                                ui.end_row();
                            }
                        }
                    });
                    ui.add_space(24.0);
                }
            });
            ui.horizontal_top(|ui| {
                Grid::new("mouse").num_columns(2).spacing([18.0, 4.0]).show(ui, |ui| {
                    ui.label(theme::strong("Mouse").color(palette.accent));
                    ui.end_row();
                    for (what, does) in MOUSE {
                        ui.monospace(what);
                        ui.label(does);
                        ui.end_row();
                    }
                });
                ui.add_space(24.0);
                ui.vertical(|ui| {
                    ui.spacing_mut().item_spacing.y = 3.0;
                    ui.label(theme::strong("Colours").color(palette.accent));
                    for meaning in [
                        (palette.hazard, "hazard state, halt, places of the actor"),
                        (palette.clear, "clear state, advance"),
                        (palette.ego, "ego vehicle, camera of the image"),
                        (palette.accent, "shown scene, camera of the view"),
                        (palette.error, "unknown state, error"),
                    ] {
                        theme::legend(ui, &[meaning]);
                    }
                });
            });
            ui.label("In the scene, bold boxes are taken places, and dots are densities. A half-transparent object");
            ui.label("means that the sample is between two states.");
            ui.weak("Esc closes this help. Enter does the same as N. The window never disturbs a running graph.");
        });
}
