"""Meshless solutions of boundary-value problems by local Taylor expansions, in JAX."""

from jsmitsm.clouds import Cloud as Cloud, box as box, interval as interval, rectangle as rectangle
