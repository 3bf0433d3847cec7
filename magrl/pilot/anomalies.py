"""Magnetic anomalies of unknown size: beliefs side by side, one for each size, weighed by how well they predict.

The field of the crust, and magnetic weather that nobody stated, have a size that a vehicle does not know. So it holds a
belief for each of some sizes. Each takes in every leg and reading, and has a weight, which changes by the likelihood
of its innovations, N(r; 0, S); now and then the size changes. What the vehicle believes is their mixture, as one normal
distribution with its moments.

All beliefs share one reference place: their estimates of the place differ by their states :data:`PLACE
<magrl.pilot.belief.PLACE>`.

Source:
    D. T. Magill, Optimal adaptive estimation of sampled stochastic processes, IEEE Transactions on Automatic Control 10
    (1965). The weights change between readings as in H. A. P. Blom and Y. Bar-Shalom, The interacting multiple
    model algorithm, IEEE Transactions on Automatic Control 33 (1988); the beliefs do not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from magrl.pilot.belief import ANOMALY, STATES, Belief, Innovation, settled
from magrl.pilot.harmonics import UNIT_KM, constant
from magrl.pilot.local import inverse3
from magrl.pilot.prior import lasting_covariances
from magrl.sensor_std import SensorStd

SIZES_NT = {3: (0.0, 30.0, 90.0), 5: (0.0, 15.0, 30.0, 60.0, 120.0)}
"""Sizes of the anomaly by their number, standard deviations in each axis [nT]; chosen: the crust of WMMHR has 26 to 42.
For sizes between them, stated errors are too small; a vehicle with integrity has five."""
PRIOR = {3: (0.6, 0.3, 0.1), 5: (0.5, 0.15, 0.15, 0.12, 0.08)}
"""Their probabilities at the start; chosen."""
CHANGES = 0.003
"""Share of legs after which the size is another one, with these probabilities; chosen. Without it, a vehicle that has
flown long in a quiet field would not find that it has come to another."""
CRUST_KM = 100.0
"""Correlation length of the field of the crust at the ground [km], of WMMHR: its correlation at a distance d is
``exp(-d^2 / (2 * CRUST_KM^2))``."""


def crust_correlation(square: Tensor) -> Tensor:
    """Return the correlation of the field of the crust at squared distances [unit^2]."""
    return torch.exp(-square / (2 * (CRUST_KM / UNIT_KM) ** 2))


def crust_share(field: Tensor, errors: SensorStd, crust_nt: Tensor) -> Tensor:
    """Return the share ``(..., 3, 3)`` of an anomaly that is the field of the crust; arguments as of
    :func:`lasting_covariances`."""
    variance = crust_nt.square()[..., None, None]
    anomaly = lasting_covariances(field, errors, crust_nt)[1]
    return torch.where(variance > 0, variance * inverse3(anomaly), 0.0)


@constant
def sizes(count: int = 3) -> Tensor:
    """Return the sizes ``(H,)`` [nT], 3 or 5.

    Example:
        >>> sizes()
        tensor([ 0., 30., 90.], dtype=torch.float64)
    """
    return torch.tensor(SIZES_NT[count], dtype=torch.float64)


def prior_weights(like: Tensor) -> Tensor:
    """Return the logarithms ``(..., H)`` of the probabilities at the start, like those of beliefs."""
    return torch.tensor(PRIOR[like.shape[-1]], dtype=torch.float64, device=like.device).log().expand(like.shape)


def side_by_side(belief: Belief, errors: SensorStd, count: int = 3) -> Belief:
    """Return a belief before its first reading once for each size of the anomaly.

    Args:
        belief: without an anomaly but the stated errors.
        errors: accuracy of the readings, tensors ``(..., 3)``.
        count: number H of the sizes, 3 or 5.

    Returns:
        Mean ``(..., H, S)``, covariance ``(..., H, S, S)``, and their place ``(..., 1, 2)``.
    """
    field, every = belief.field.unsqueeze(-2), sizes(count).to(belief.mean)
    errors = SensorStd(*(torch.as_tensor(std).unsqueeze(-2) for std in errors))
    stated, whole = (lasting_covariances(field, errors, size)[1] for size in (every[:1], every))
    added = pad(whole - stated, (ANOMALY.start, STATES - ANOMALY.stop) * 2)
    mean = belief.mean.unsqueeze(-2).expand(*belief.mean.shape[:-1], count, STATES)
    return Belief(mean, belief.covariance.unsqueeze(-3) + added, belief.place.unsqueeze(-2))


def mixture(beliefs: Belief, log_weight: Tensor) -> Belief:
    """Return the normal distribution with the moments of beliefs side by side.

    Args:
        beliefs: as :func:`side_by_side` returns them.
        log_weight: ``(..., H)`` logarithms of their weights.

    Example:
        >>> beliefs = Belief(torch.tensor([[0.0], [4.0]]), torch.ones(2, 1, 1), torch.zeros(1, 2))
        >>> mixture(beliefs, torch.tensor([0.75, 0.25]).log())[:2]
        (tensor([1.]), tensor([[4.]]))
    """
    weight = log_weight.exp()
    mean = (weight.unsqueeze(-1) * beliefs.mean).sum(-2)
    apart = (beliefs.mean - mean.unsqueeze(-2)) * weight.sqrt().unsqueeze(-1)
    covariance = (weight[..., None, None] * beliefs.covariance).sum(-3) + apart.mT @ apart
    return Belief(mean, covariance, beliefs.place.squeeze(-2))


def recentered(beliefs: Belief, log_weight: Tensor) -> Belief:
    """Return beliefs side by side with the mean of their places as the reference place."""
    one = mixture(beliefs, log_weight)
    after = settled(one)
    shift = one.mean - after.mean
    return Belief(beliefs.mean - shift.unsqueeze(-2), beliefs.covariance, after.place.unsqueeze(-2))


def reweighed(log_weight: Tensor, new: Innovation) -> tuple[Tensor, Tensor]:
    """Return the logarithms of the weights ``(..., H)`` after a reading, and before the next, for which the
    surroundings may change; and of the evidence ``(...)``, the likelihood of the reading by all beliefs up to a factor.

    Args:
        log_weight: those before.
        new: innovation of each belief.
    """
    joint = log_weight - (new.square() + torch.logdet(new.covariance)) / 2
    after = torch.log_softmax(joint, -1)
    after = torch.logaddexp(after + math.log1p(-CHANGES), prior_weights(after) + math.log(CHANGES))
    return after, torch.logsumexp(joint, -1)


def tail(log_weight: Tensor, new: Innovation, count: Tensor) -> Tensor:
    """Return the probability ``(...)`` of a reading that is more surprising, where everything stated is true.

    Args:
        log_weight: ``(..., H)`` logarithms of the weights before the reading.
        new: innovation of each belief, whose normalized square is chi-square of the elements that were read.
        count: ``(..., 1)`` number of those.

    Example:
        >>> new = Innovation(torch.tensor([[0.0, 0.0, 3.0]]), torch.eye(3).unsqueeze(0), torch.eye(3).unsqueeze(0))
        >>> tail(torch.zeros(1), new, torch.tensor([3])).round(decimals=3)
        tensor(0.0290)
    """
    return (log_weight.exp() * torch.special.gammaincc((count / 2).to(log_weight), new.square() / 2)).sum(-1)


def joint_tail(tails: Sequence[float]) -> float:
    """Return the probability that some tail probabilities, which are uniform where everything stated is true, are as
    small in product.

    Source:
        R. A. Fisher, Statistical Methods for Research Workers (1932), section 21.1.

    Example:
        >>> round(joint_tail([0.1, 0.1]), 3)
        0.056
    """
    product = -sum(math.log(max(tail, 1e-300)) for tail in tails)
    return float(torch.special.gammaincc(*torch.tensor([len(tails) or 1, product], dtype=torch.float64)))
