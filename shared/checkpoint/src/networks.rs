//! What the networks of a checkpoint compute, in whichever library.

use carff_decision::Mixture;
use carff_messages::Gaussian;
use ndarray::ArrayView3;

/// An encoder: from one image to a Gaussian over the scene latent.
pub trait Encodes {
    /// Returns the posterior of an image (height, width, channel); `None` for an image that cannot be encoded.
    fn posterior_of(&self, image: ArrayView3<'_, u8>) -> Option<Gaussian>;
}

/// A mixture density network: from one posterior to the belief over the next scene latent.
pub trait Forecasts {
    /// Returns the forecast of one posterior.
    fn forecast(&self, posterior: &Gaussian) -> Mixture;

    /// Returns the forecasts of many posteriors, in their order.
    fn forecast_all(&self, posteriors: &[Gaussian]) -> Vec<Mixture> {
        posteriors.iter().map(|posterior| self.forecast(posterior)).collect()
    }
}
