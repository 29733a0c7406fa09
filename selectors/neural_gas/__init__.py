"""Neural gas (section III): nodes trained on the seeds, and the regions read from them."""

from selective_depth.selectors.neural_gas.batch import BatchNeuralGas
from selective_depth.selectors.neural_gas.exact import train_exact
from selective_depth.selectors.neural_gas.regions import EdgeMetric, RegionSelection, delaunay_regions
from selective_depth.selectors.neural_gas.selector import LongEdgeSelector, NeuralGasSelector, node_pixels

__all__ = [
    "BatchNeuralGas",
    "EdgeMetric",
    "LongEdgeSelector",
    "NeuralGasSelector",
    "RegionSelection",
    "delaunay_regions",
    "node_pixels",
    "train_exact",
]
