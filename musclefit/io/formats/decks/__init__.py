"""Decks of solvers: LS-DYNA, Abaqus and FEBio input read for nodes and elements, and rewritten with the nodes moved.

Nothing but the coordinates of nodes is changed: every other byte of a deck stays as it was.
"""
