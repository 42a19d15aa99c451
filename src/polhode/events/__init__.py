"""Events: when a function of attitude, rates and time crosses zero, and motions that stop there."""

from polhode.events._crossings import Crossings as Crossings, crossings as crossings
from polhode.events._event import Event as Event
from polhode.events._until import check_until as check_until, stopped as stopped
