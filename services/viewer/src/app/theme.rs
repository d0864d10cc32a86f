//! The look of the window: fonts, colours and spacing, dark and light.

use eframe::egui::{
    self, Color32, Context, CornerRadius, FontData, FontDefinitions, FontFamily, FontId, Frame, IconData, Margin,
    RichText, Stroke, TextStyle, Theme, Visuals, vec2,
};
use std::sync::Arc;

/// Colours by meaning, for one theme.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Palette {
    /// Background of the window.
    pub ground: Color32,
    /// Background of panes.
    pub pane: Color32,
    /// Background of elements on a pane.
    pub raised: Color32,
    /// Colour of thin lines.
    pub line: Color32,
    /// Colour of less important text.
    pub weak: Color32,
    /// Colour of the selection and of the main button.
    pub accent: Color32,
    /// Colour of text on the accent.
    pub on_accent: Color32,
    /// Colour of hazard and halt.
    pub hazard: Color32,
    /// Colour of clear and advance.
    pub clear: Color32,
    /// Colour of the ego vehicle.
    pub ego: Color32,
    /// Colour of errors.
    pub error: Color32,
    /// Colours of the lines of a plot.
    pub lines: [Color32; 5],
    /// Colours of a slice, from empty to dense.
    pub density: [Color32; 4],
}

const fn rgb(hex: u32) -> Color32 {
    Color32::from_rgb((hex >> 16) as u8, (hex >> 8) as u8, hex as u8)
}

const DARK: Palette = Palette {
    ground: rgb(0x0011_1419),
    pane: rgb(0x0018_1c23),
    raised: rgb(0x0023_2932),
    line: rgb(0x002e_3641),
    weak: rgb(0x0093_9eac),
    accent: rgb(0x003f_b6c9),
    on_accent: rgb(0x0007_1a1e),
    hazard: rgb(0x00f0_9a3e),
    clear: rgb(0x0056_c28a),
    ego: rgb(0x0067_a9ff),
    error: rgb(0x00ff_6f61),
    lines: [rgb(0x003f_b6c9), rgb(0x00f0_9a3e), rgb(0x0056_c28a), rgb(0x00c3_8bf5), rgb(0x00ff_6f91)],
    density: [rgb(0x0014_1822), rgb(0x0051_2f7c), rgb(0x00d9_5f6a), rgb(0x00ff_e5a0)],
};

const LIGHT: Palette = Palette {
    ground: rgb(0x00e6_e9ee),
    pane: rgb(0x00f6_f7f9),
    raised: rgb(0x00ff_ffff),
    line: rgb(0x00cf_d6df),
    weak: rgb(0x0062_6d7a),
    accent: rgb(0x000f_7f93),
    on_accent: rgb(0x00ff_ffff),
    hazard: rgb(0x00c7_6a0a),
    clear: rgb(0x001d_8f56),
    ego: rgb(0x001f_6fd0),
    error: rgb(0x00c6_2f2f),
    lines: [rgb(0x000f_7f93), rgb(0x00c7_6a0a), rgb(0x001d_8f56), rgb(0x0078_3fc4), rgb(0x00b8_2a5c)],
    density: [rgb(0x00fb_fbfd), rgb(0x00c9_b3e6), rgb(0x00a6_3d6b), rgb(0x002a_1038)],
};

/// Returns the palette of the current theme.
pub fn palette(ctx: &Context) -> &'static Palette {
    match ctx.theme() {
        Theme::Dark => &DARK,
        Theme::Light => &LIGHT,
    }
}

/// Returns the palette for overlays on images, which is the same in both themes.
pub fn on_images() -> &'static Palette {
    &DARK
}

impl Palette {
    /// Returns the colour of a share of absorbed light, 0..=1.
    pub fn of_density(&self, share: f32) -> Color32 {
        let place = share.clamp(0.0, 1.0) * (self.density.len() - 1) as f32;
        let first = (place as usize).min(self.density.len() - 2);
        self.density[first].lerp_to_gamma(self.density[first + 1], place - first as f32)
    }

    /// Returns the colour of the actor at a place.
    pub fn of_place(&self, name: &str) -> Color32 {
        if name == "ego" { self.ego } else { self.hazard }
    }
}

fn bold() -> FontFamily {
    FontFamily::Name("bold".into())
}

/// Sets fonts and styles of both themes.
pub fn install(ctx: &Context) {
    let mut fonts = FontDefinitions::empty();
    for (name, bytes) in [
        ("sans", dejavu::sans_condensed::regular()),
        ("bold", dejavu::sans_condensed::bold()),
        ("mono", dejavu::sans_mono::regular()),
        // The condensed family has fewer glyphs.
        ("signs", dejavu::sans::regular()),
    ] {
        fonts.font_data.insert(name.to_owned(), Arc::new(FontData::from_static(bytes)));
    }
    for (family, names) in [
        (FontFamily::Proportional, ["sans", "signs"]),
        (FontFamily::Monospace, ["mono", "signs"]),
        (bold(), ["bold", "signs"]),
    ] {
        fonts.families.insert(family, names.map(str::to_owned).to_vec());
    }
    ctx.set_fonts(fonts);
    for (theme, palette) in [(Theme::Dark, &DARK), (Theme::Light, &LIGHT)] {
        ctx.style_mut_of(theme, |style| {
            style.visuals = visuals(theme, palette);
            style.spacing.item_spacing = vec2(7.0, 6.0);
            style.spacing.button_padding = vec2(9.0, 4.0);
            style.spacing.interact_size.y = 24.0;
            style.spacing.slider_width = 96.0;
            style.spacing.scroll = egui::style::ScrollStyle::thin();
            style.interaction.selectable_labels = false;
            style.text_styles = [
                (TextStyle::Heading, FontId::new(15.0, bold())),
                (TextStyle::Body, FontId::new(12.5, FontFamily::Proportional)),
                (TextStyle::Button, FontId::new(12.5, FontFamily::Proportional)),
                (TextStyle::Small, FontId::new(10.5, FontFamily::Proportional)),
                (TextStyle::Monospace, FontId::new(11.5, FontFamily::Monospace)),
            ]
            .into();
        });
    }
}

fn visuals(theme: Theme, palette: &Palette) -> Visuals {
    let mut v = theme.default_visuals();
    v.panel_fill = palette.pane;
    v.window_fill = palette.pane;
    v.window_stroke = Stroke::new(1.0, palette.line);
    v.extreme_bg_color = palette.ground;
    v.faint_bg_color = palette.raised;
    v.weak_text_color = Some(palette.weak);
    v.selection.bg_fill = palette.accent.gamma_multiply(0.45);
    v.selection.stroke = Stroke::new(1.0, palette.accent);
    v.hyperlink_color = palette.accent;
    v.error_fg_color = palette.error;
    v.warn_fg_color = palette.hazard;
    v.window_corner_radius = CornerRadius::same(10);
    v.menu_corner_radius = CornerRadius::same(8);
    v.slider_trailing_fill = true;
    let text = if theme == Theme::Dark { rgb(0x00e2_e7ee) } else { rgb(0x001d_242c) };
    let w = &mut v.widgets;
    for state in [&mut w.noninteractive, &mut w.inactive, &mut w.hovered, &mut w.active, &mut w.open] {
        state.corner_radius = CornerRadius::same(6);
        state.fg_stroke = Stroke::new(1.0, text);
        state.bg_stroke = Stroke::new(1.0, palette.line);
        state.expansion = 0.0;
    }
    for state in [&mut w.inactive, &mut w.open] {
        (state.bg_fill, state.weak_bg_fill) = (palette.raised, palette.raised);
    }
    for state in [&mut w.hovered, &mut w.active] {
        let fill = palette.raised.lerp_to_gamma(palette.accent, 0.22);
        (state.bg_fill, state.weak_bg_fill) = (fill, fill);
        state.bg_stroke = Stroke::new(1.0, palette.accent);
    }
    v
}

/// Returns the window's icon: the observed scene and its branches.
pub fn icon() -> IconData {
    const SIDE: u32 = 64;
    let rgba = (0..SIDE * SIDE)
        .flat_map(|i| {
            let [column, row] = [i % SIDE, i / SIDE].map(|p| p as f32 + 0.5);
            let distance = |x: f32, y: f32| (column - x).hypot(row - y);
            let ring = (distance(28.0, 34.0) - 18.0).abs() < 4.0;
            let color = if distance(47.0, 17.0) < 9.0 {
                DARK.hazard
            } else if ring {
                DARK.accent
            } else {
                DARK.ground
            };
            color.to_array()
        })
        .collect();
    IconData { rgba, width: SIDE, height: SIDE }
}

/// Returns a pane's frame.
pub fn pane(palette: &Palette) -> Frame {
    Frame::new().fill(palette.pane).inner_margin(Margin::symmetric(12, 10)).stroke(Stroke::new(1.0, palette.line))
}

/// Formats the heading of a pane.
pub fn heading(text: impl Into<String>) -> RichText {
    RichText::new(text).text_style(TextStyle::Heading)
}

/// Formats bold text of body size.
pub fn strong(text: impl Into<String>) -> RichText {
    RichText::new(text).font(FontId::new(12.5, bold()))
}

/// Shows the meanings of colours in one wrapped line.
pub fn legend(ui: &mut egui::Ui, meanings: &[(Color32, &str)]) {
    let height = ui.spacing().interact_size.y;
    ui.spacing_mut().interact_size.y = 12.0;
    ui.horizontal_wrapped(|ui| {
        for (color, meaning) in meanings {
            ui.spacing_mut().item_spacing.x = 3.0;
            ui.label(small("●").color(*color));
            ui.spacing_mut().item_spacing.x = 9.0;
            ui.label(small(*meaning).color(palette(ui.ctx()).weak));
        }
    });
    ui.spacing_mut().interact_size.y = height;
}

/// Formats small text.
pub fn small(text: impl Into<String>) -> RichText {
    RichText::new(text).text_style(TextStyle::Small)
}
