"""The best mission as a mixed-integer program on the time-expanded grid, solved by HiGHS.

A node is a cell after a step, before or after the arrival. A variable is a move from node to node, 0 or 1.
One more for each user is whether it is collected:

    maximise   w / U sum_u y_u + sum over arriving moves x of (1 - w) (1 - t / T) x
    such that  the moves are a path from the start to its end,
               y_u <= sum over moves into (t, c) of share[t, c, u] x
"""

from dataclasses import dataclass

import numpy as np

from uav_dc_ros.core.arrays import Array
from uav_dc_ros.errors import UavDcError
from uav_dc_ros.experiments.optimum.problem import ClairvoyantProblem


@dataclass(frozen=True)
class Program:
    """What HiGHS found."""

    actions: Array  # of the best mission, integers; none where it found none in time
    bound: float  # of J
    stopped: bool  # the time limit ended the search


def solve_program(problem: ClairvoyantProblem, weight: float, time_limit_s: float = np.inf) -> Program:
    """Solve the program of a problem for J with the weight w.

    Raises:
        UavDcError: highspy is not installed.
    """
    try:
        import highspy
    except ModuleNotFoundError:
        raise UavDcError(
            'highspy is not installed; expected it from: pip install "uav_dc_ros[optimum]"'
        ) from None
    moves = _Moves(problem)
    n_moves, n_users = len(moves.step), problem.n_users
    arrivals = np.where(moves.arrives, (1.0 - weight) * (1.0 - moves.step / problem.n_steps), 0.0)
    # Rows: a user is collected from its data; then, at each node, as many moves leave as enter.
    delivered = problem.share[moves.step - 1, moves.cell]  # `[n, U]`
    move, user = np.nonzero(delivered)
    n_nodes = moves.n_nodes
    column = np.concatenate([move, n_moves + np.arange(n_users), np.arange(n_moves), np.arange(n_moves)])
    row = np.concatenate([user, np.arange(n_users), n_users + moves.source, n_users + moves.target])
    value = np.concatenate([-delivered[move, user], np.ones(n_users), np.ones(n_moves), -np.ones(n_moves)])
    order = np.lexsort((row, column))
    lp = highspy.HighsLp()
    lp.num_col_, lp.num_row_ = n_moves + n_users, n_users + n_nodes
    lp.sense_ = highspy.ObjSense.kMaximize
    lp.col_cost_ = np.concatenate([arrivals, np.full(n_users, weight / n_users)])
    lp.col_lower_, lp.col_upper_ = np.zeros(lp.num_col_), np.ones(lp.num_col_)
    balance = np.zeros(n_nodes)
    balance[moves.first], balance[moves.last] = 1.0, -1.0
    lp.row_lower_ = np.concatenate([np.full(n_users, -highspy.kHighsInf), balance])
    lp.row_upper_ = np.concatenate([np.zeros(n_users), balance])
    lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    lp.a_matrix_.start_ = np.searchsorted(column[order], np.arange(lp.num_col_ + 1))
    lp.a_matrix_.index_, lp.a_matrix_.value_ = row[order], value[order]
    lp.integrality_ = [highspy.HighsVarType.kInteger] * lp.num_col_
    solver = highspy.Highs()
    solver.setOptionValue("output_flag", False)
    solver.setOptionValue("time_limit", time_limit_s)
    solver.setOptionValue("threads", 1)
    solver.setOptionValue("mip_rel_gap", 0.0)
    solver.setOptionValue("mip_abs_gap", 1e-9)
    solver.passModel(lp)
    solver.run()
    info = solver.getInfo()
    bound = min(float(info.mip_dual_bound), 1.0)
    stopped = solver.getModelStatus() == highspy.HighsModelStatus.kTimeLimit
    if info.primal_solution_status != highspy.SolutionStatus.kSolutionStatusFeasible:
        return Program(np.zeros(0, np.int64), bound, stopped)
    flown = np.flatnonzero(np.asarray(solver.getSolution().col_value[:n_moves]) > 0.5)
    flown = flown[np.argsort(moves.step[flown], kind="stable")]
    return Program(moves.action[flown], bound, stopped)


class _Moves:
    """Every move of a mission that can still land: `[n]` each."""

    def __init__(self, problem: ClairvoyantProblem) -> None:
        model, n_steps = problem.model, problem.n_steps
        n_cells = len(model.cells)
        # Phases before and after (1 begins with the arrival), step, cell before, action, cell after
        parts: list[tuple[int, int, int, Array, Array, Array]] = []
        here, over = np.asarray([problem.start_cell]), np.flatnonzero(model.docked)
        for t in range(1, n_steps + 1):
            source, action = np.nonzero(model.has_effect[here])
            source = here[source]
            cell = model.after[source, action]
            docked = model.docked[cell]
            away = (model.steps_home[cell] <= n_steps - t) & ~(docked & problem.ends_on_arrival)
            away &= t < n_steps
            parts.append((0, 0, t, source[away], action[away], cell[away]))
            parts.append((0, 1, t, source[docked], action[docked], cell[docked]))
            here = np.unique(cell[away])
            if t > 1 and not problem.ends_on_arrival:
                source, action = np.nonzero(model.has_effect[over])
                source = over[source]
                cell = model.after[source, action]
                stays = model.docked[cell]
                parts.append((1, 1, t, source[stays], action[stays], cell[stays]))
        sizes = [len(part[3]) for part in parts]
        phase, to, step = (np.repeat([part[i] for part in parts], sizes) for i in range(3))
        source, action, cell = (np.concatenate([part[i] for part in parts]) for i in range(3, 6))

        def node(phase: Array, step: Array, cell: Array) -> Array:
            return (phase * (n_steps + 1) + step) * n_cells + cell

        ends = np.flatnonzero((to == 1) & (problem.ends_on_arrival | (step == n_steps)))
        self.step: Array = step
        self.action: Array = action
        self.cell: Array = cell
        self.arrives: Array = (phase == 0) & (to == 1)
        sources, targets = node(phase, step - 1, source), node(to, step, cell)
        sink = 2 * (n_steps + 1) * n_cells
        targets[ends] = sink
        nodes, index = np.unique(np.concatenate([sources, targets]), return_inverse=True)
        ends_of_moves: Array = index.reshape(2, -1)
        self.source, self.target = ends_of_moves
        self.n_nodes = len(nodes)
        self.first = int(np.searchsorted(nodes, node(0, 0, problem.start_cell)))
        self.last = int(np.searchsorted(nodes, sink))
