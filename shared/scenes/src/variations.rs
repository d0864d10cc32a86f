//! Variations of a scenario: the dynamic vehicle looks different, or an object is added to every state.

use crate::bystanders::object_of;
use crate::config::{AppearanceConfig, BystanderConfig};
use crate::scenario::Unknown;
use crate::{Scenario, ScenarioError};

impl Scenario {
    /// Returns the vehicles that may replace the dynamic vehicle, in the order of the file.
    pub fn appearances(&self) -> &[AppearanceConfig] {
        &self.config().appearance
    }

    /// Returns the objects that can be added, in the order of the file.
    pub fn bystanders(&self) -> &[BystanderConfig] {
        &self.config().bystander
    }

    /// Returns the scenario with another dynamic vehicle at the same places. Cameras and free poses are those of this
    /// scenario.
    ///
    /// # Errors
    ///
    /// No appearance of the file has this name.
    pub fn with_appearance(&self, name: &str) -> Result<Self, ScenarioError> {
        let all = self.appearances();
        let missing = || self.no_such("appearance", name, all.iter().map(|a| &a.name));
        let appearance = all.iter().find(|a| a.name == name).ok_or_else(missing)?;
        let mut config = self.config().clone();
        for vehicle in config.vehicle.iter_mut().filter(|v| v.dynamic) {
            vehicle.kind = appearance.kind;
            vehicle.colour = appearance.colour;
            vehicle.size_m = appearance.size_m;
            vehicle.heading_deg = appearance.heading_deg;
        }
        Ok(self.varied(config, Unknown { appearance: true, ..*self.unknown() }, 0))
    }

    /// Returns the scenario with a bystander in every state, as a static object. Cameras and free poses are those of
    /// this scenario. Several calls add several objects.
    ///
    /// # Errors
    ///
    /// No bystander of the file has this name, or it was already added.
    pub fn with_object(&self, name: &str) -> Result<Self, ScenarioError> {
        let all = self.bystanders();
        let missing = || self.no_such("bystander", name, all.iter().map(|b| &b.name));
        let index = all.iter().position(|b| b.name == name).ok_or_else(missing)?;
        let mut config = self.config().clone();
        let bystander = config.bystander.remove(index);
        config.object.push(object_of(&bystander, &config.slab));
        Ok(self.varied(config, Unknown { bystanders: self.unknown().bystanders + 1, ..*self.unknown() }, 1))
    }

    /// Returns the error of a name that a table of the file does not have.
    pub(crate) fn no_such<'a>(
        &self,
        key: &'static str,
        name: &str,
        known: impl Iterator<Item = &'a String>,
    ) -> ScenarioError {
        let (path, name) = (self.path().to_owned(), name.to_owned());
        ScenarioError::NoSuchName { path, key, name, known: known.cloned().collect() }
    }
}
