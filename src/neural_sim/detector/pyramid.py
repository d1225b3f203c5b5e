"""Detectors of a backbone, torchvision's feature pyramid on it, and a head that all levels have in common."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn
from torch.func import functional_call

from neural_sim.detector.network import build_predictor
from neural_sim.detector.on_backbone import BackboneDetector
from neural_sim.detector.protocol import Outputs, Parameters
from neural_sim.detector.settings import ARCHITECTURES, Backbone, Detections, Head, check


class PyramidDetector(BackboneDetector):
    """A backbone, a feature pyramid and a head; a subclass makes the head, and its targets and losses.

    Args:
        head: its settings, and the pyramid's.
        strides: of the pyramid's levels; ``where`` is their key.
        network: the head's module, of :attr:`Head.channels` channels; it returns ``cls_logits`` [n, anchors, classes]
            and ``bbox_regression`` [n, anchors, code].
        activation: ``silu`` or ``relu`` (torchvision's own), of backbone, pyramid and head.
        detections: see :class:`Detector`.

    See :class:`BackboneDetector` for the others.

    Raises:
        ValueError: any of these out of its range, or strides that the backbone does not have, with the key and value.
    """

    def __init__(
        self,
        num_classes: int,
        image_size: int | tuple[int, int],
        backbone: Backbone,
        head: Head,
        strides: Sequence[int],
        where: str,
        network: nn.Module,
        detections: Detections,
        activation: str,
        proximal: float,
    ) -> None:
        strides, available = tuple(strides), ARCHITECTURES[backbone.architecture]
        own = tuple(stride for stride in strides if stride in available)
        check(
            where,
            strides=(
                strides,
                len(own) > 0
                and own == tuple(sorted(set(own)))
                and strides[len(own) :] == _coarser(own, strides, available),
                f"an ascending choice of {available} for {backbone.architecture}, and from its last on "
                "coarser ones, each twice the one before",
            ),
        )
        super().__init__(num_classes, image_size, backbone, own, activation, proximal, head.prior)
        self.detections = detections
        self._predictor = build_predictor(self._widths, len(strides), network, head, activation)

    def outputs(self, trainable: Parameters, features: Sequence[Tensor]) -> Outputs:
        predictor, maps = self.completed(trainable, features)
        out = functional_call(self._predictor, predictor, (maps,), strict=True)
        return out["cls_logits"], out["bbox_regression"]


def _coarser(own: tuple[int, ...], strides: tuple[int, ...], available: tuple[int, ...]) -> tuple[int, ...]:
    """Strides of the levels past the backbone's last, where as many as there are may follow it."""
    last, count = available[-1], len(strides) - len(own)
    return tuple(last * 2**n for n in range(1, count + 1)) if last in own else ()
