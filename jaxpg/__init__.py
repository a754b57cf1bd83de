"""Policy gradients for robots as one XLA program.

The equations are pure functions of arrays, to be imported one at a time:

    from jaxpg.returns import lambda_returns
    from jaxpg.distributions import squashed_gaussian_log_prob

`python -m jaxpg.train env=pendulum` trains; `python -m jaxpg.evaluate run=DIR` evaluates.
"""

import jaxlib

from jaxpg.compatibility import check_jaxlib

check_jaxlib(jaxlib.__version__)

__version__ = "0.1.0"
