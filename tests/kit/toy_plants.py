"""A plant of a user in a module that can be imported."""

from kit.own import PLAIN_CELL

exec(PLAIN_CELL)
