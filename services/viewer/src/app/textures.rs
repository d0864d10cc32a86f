//! Textures of the displayed images.

use super::theme;
use carff_dataset::Image;
use eframe::egui::{ColorImage, Context, TextureHandle, TextureId, TextureOptions, Theme};

/// The window's images.
#[derive(Default)]
pub struct Textures {
    view: Option<TextureHandle>,
    birds_eye: Option<TextureHandle>,
    slice: Option<TextureHandle>,
    /// The slice's density image, and the theme of its texture.
    density: Option<(Image, Theme)>,
    thumbnails: Vec<Option<TextureHandle>>,
    input: Option<(Image, TextureHandle)>,
}

fn set(ctx: &Context, slot: &mut Option<TextureHandle>, name: &str, image: ColorImage, options: TextureOptions) {
    match slot {
        Some(texture) => texture.set(image, options),
        None => *slot = Some(ctx.load_texture(name, image, options)),
    }
}

fn colors(image: &Image) -> ColorImage {
    ColorImage::from_rgb([image.width_px as usize, image.height_px as usize], &image.rgb)
}

impl Textures {
    /// Sets the image of the view.
    pub fn set_view(&mut self, ctx: &Context, image: &Image) {
        set(ctx, &mut self.view, "view", colors(image), TextureOptions::LINEAR);
    }

    /// Sets the image from above.
    pub fn set_birds_eye(&mut self, ctx: &Context, image: &Image) {
        set(ctx, &mut self.birds_eye, "birds-eye", colors(image), TextureOptions::LINEAR);
    }

    /// Sets the slice of density.
    pub fn set_slice(&mut self, ctx: &Context, image: Image) {
        self.density = Some((image, ctx.theme()));
        self.color_slice(ctx);
    }

    fn color_slice(&mut self, ctx: &Context) {
        let Some((image, _)) = &self.density else { return };
        let palette = theme::palette(ctx);
        let pixels = image.rgb.chunks_exact(3).map(|p| palette.of_density(f32::from(p[0]) / 255.0)).collect();
        let colored = ColorImage::new([image.width_px as usize, image.height_px as usize], pixels);
        set(ctx, &mut self.slice, "slice", colored, TextureOptions::LINEAR);
    }

    /// Sets a thumbnail.
    pub fn set_thumbnail(&mut self, ctx: &Context, index: usize, image: &Image) {
        if self.thumbnails.len() <= index {
            self.thumbnails.resize_with(index + 1, || None);
        }
        set(ctx, &mut self.thumbnails[index], "scene", colors(image), TextureOptions::LINEAR);
    }

    /// Returns the texture of the view.
    pub fn view(&self) -> Option<TextureId> {
        self.view.as_ref().map(TextureHandle::id)
    }

    /// Returns the texture of the image from above.
    pub fn birds_eye(&self) -> Option<TextureId> {
        self.birds_eye.as_ref().map(TextureHandle::id)
    }

    /// Returns the texture of the slice in the colours of the current theme.
    pub fn slice(&mut self, ctx: &Context) -> Option<TextureId> {
        if let Some((_, theme)) = &mut self.density
            && *theme != ctx.theme()
        {
            *theme = ctx.theme();
            self.color_slice(ctx);
        }
        self.slice.as_ref().map(TextureHandle::id)
    }

    /// Returns the texture of a thumbnail.
    pub fn thumbnail(&self, index: usize) -> Option<TextureId> {
        self.thumbnails.get(index)?.as_ref().map(TextureHandle::id)
    }

    /// Returns the texture of the input image without interpolation, so that single pixels are visible.
    pub fn input(&mut self, ctx: &Context, image: &Image) -> TextureId {
        match &mut self.input {
            Some((shown, texture)) if shown == image => texture.id(),
            Some((shown, texture)) => {
                texture.set(colors(image), TextureOptions::NEAREST);
                *shown = image.clone();
                texture.id()
            }
            None => {
                let texture = ctx.load_texture("input", colors(image), TextureOptions::NEAREST);
                let id = texture.id();
                self.input = Some((image.clone(), texture));
                id
            }
        }
    }
}
