"""Levenberg–Marquardt for calibration problems: optimistix's, with a stop rule for batches."""

import equinox as eqx
import optimistix as optx


class LevenbergMarquardt(optx.LevenbergMarquardt):
    """optimistix's Levenberg–Marquardt that also stops when the step it proposes is below tolerance.

    The original stops on an accepted step only. At the optimum rounding decides whether a step counts as progress, so
    some lanes of a batch reject for twenty more steps while all others wait. A proposal is small also under heavy
    damping, far from any optimum: it counts only while the damping is no more than at the start.
    """

    def step(self, fn, y, args, options, state, tags):
        y, state, aux = super().step(fn, y, args, options, state, tags)
        proposed = self.norm(state.y_eval - y)
        small = proposed < self.atol + self.rtol * self.norm(y)
        converged = small & (state.search_state.step_size >= 1) & (state.num_accepted_steps > 0)
        # `limit` ends a lane like `max_steps`, but is an array: two stages share one compiled function.
        done = state.terminate | converged | (state.num_steps >= options["limit"])
        return y, eqx.tree_at(lambda s: s.terminate, state, done), aux
