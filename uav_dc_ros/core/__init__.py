"""The world as pure functions: no ROS, no torch, no I/O.

Every function works on arrays with any number of leading batch dimensions and on any array library
that speaks the array API standard (numpy and torch are tested): the same code serves one mission in
a node and thousands of worlds on a GPU. Random draws are arguments.

    scenario   every value of a world, read strictly
    radio      distance, path gain, SINR, rate
    mobility   the users' random walk
    grid       cells, actions, moves
    mission    who is served, what is collected, has it landed
    reward     R_plus, the reward, its immediate and its episode form
    pace       lockstep, or a multiple of real time
    world      State, initial(), step(): the composition of the above
    bootstrap  intervals of means
"""
