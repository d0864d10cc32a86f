//! Slices of density: a scene at a height, as an image from above.

use carff_dataset::Image;
use carff_field::{Field, LATENT_DIM};

/// Length over which opacity is computed, metres: the field's surfaces are thin.
const DEPTH_M: f32 = 0.25;

/// Returns the share of light that 0.25 m of the scene absorbs at a height: black none, white all. The image covers the
/// region of interest, +X to the right, +Y up, with `longest_px` points along its longer side.
pub fn density_slice(field: &Field, latent: &[f32; LATENT_DIM], height_m: f32, longest_px: u32) -> Image {
    let (width_px, height_px, densities) = field.density_slice(latent, height_m, longest_px);
    let rgb = densities.iter().flat_map(|d| [(255.0 * (1.0 - (-d.max(0.0) * DEPTH_M).exp())) as u8; 3]).collect();
    Image { width_px, height_px, rgb }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_field::FieldConfig;

    /// The image has the region's aspect ratio, and each pixel is the field's value at the pixel's centre.
    #[test]
    fn pixels_are_the_fields_densities() {
        let bounds_m = [[-4.0, -2.0, 0.0], [4.0, 2.0, 3.0]];
        let field = Field::new(FieldConfig { bounds_m, log2_table_size: 8, ..FieldConfig::default() }, 5).unwrap();
        let latent = [0.4; LATENT_DIM];
        let image = density_slice(&field, &latent, 1.5, 16);
        assert_eq!((image.width_px, image.height_px), (16, 8));
        let mut density = [0.0];
        field.density(&[[-4.0 + 0.5 * 3.5, 2.0 - 0.5 * 1.5, 1.5]], &latent, &mut density);
        let expected = (255.0 * (1.0 - (-density[0].max(0.0) * DEPTH_M).exp())) as u8;
        assert_eq!(image.pixel(3, 1), Some([expected; 3]));
    }
}
