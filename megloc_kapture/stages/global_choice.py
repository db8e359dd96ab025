"""Which global features retrieval uses: VLAD trained on the map, or an image network."""

from __future__ import annotations

from pydantic import Field, ValidationError

from megloc_kapture.errors import OptionError
from megloc_kapture.features.vlad import VladOptions
from megloc_kapture.plugins import (
    GLOBAL_FEATURES,
    GlobalFeatureExtractor,
    PluginChoice,
    load_plugin,
    plugin_names,
)
from megloc_kapture.stages.global_vlad import vlad_type

VLAD = "vlad"


class VladChoiceOptions(VladOptions):
    """Options of the global features ``vlad``."""

    local_type: str | None = Field(
        default=None, description="local features to aggregate; none: the first of the run"
    )

    def of_vlad(self) -> VladOptions:
        """How the vocabulary is trained and used."""
        return VladOptions(**self.model_dump(exclude={"local_type"}))


class GlobalFeaturesChoice(PluginChoice):
    """Global features by name: ``vlad``, or a plugin; its options, and its weight in fusion."""

    name: str = VLAD
    weight: float = Field(default=1.0, gt=0, description="among the features that are fused")

    @property
    def is_vlad(self) -> bool:
        """Whether they are trained on the map's local features."""
        return self.name == VLAD

    def vlad_options(self) -> VladChoiceOptions:
        """The options of VLAD; raises OptionError."""
        try:
            return VladChoiceOptions(**self.options)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            raise OptionError(f"global features vlad: option {where}: {first['msg']}") from error

    def make(self) -> GlobalFeatureExtractor:
        """The extractor of an image network.

        Raises
        ------
        OptionError : there are no such global features.
        PluginError, MissingWeightsError : it cannot be loaded, or refuses its options.
        """
        known = plugin_names(GLOBAL_FEATURES)
        if self.name not in known:
            raise OptionError(
                f"unknown global features {self.name!r}; known: {', '.join([VLAD, *known])}"
            )
        extractor: GlobalFeatureExtractor = load_plugin(GLOBAL_FEATURES, self.name, self.options)
        return extractor

    def type_name(self, main_local_type: str) -> str:
        """The kapture type name of the vectors; raises as :meth:`make` and :meth:`vlad_options`.

        Parameters
        ----------
        main_local_type : local features that VLAD takes where its options name none.
        """
        if self.is_vlad:
            return vlad_type(self.vlad_options().local_type or main_local_type)
        return self.make().name
