"""Events: zero crossings of functions of attitude, rates and time, and motions that stop there."""

from polhode._events._crossings import Crossings as Crossings, crossings as crossings
from polhode._events._event import Event as Event, require_bodies as require_bodies
from polhode._events._simulation import (
    check_until as check_until,
    checked_events as checked_events,
    events_by_search as events_by_search,
    events_by_steps as events_by_steps,
    stop_at_event as stop_at_event,
)
