"""What scenes are made of: parts with batch axes, and the functions that users give them."""

from polhode._parts._functions import (
    Signature as Signature,
    kept as kept,
    result_of as result_of,
    takes as takes,
)
from polhode._parts._part import (
    AbstractPart as AbstractPart,
    check_fields as check_fields,
    shaped as shaped,
    terms_of as terms_of,
)
