import inspect
import sys
from functools import partial
from types import ModuleType, SimpleNamespace

from placegraph_io.ros.decode import typestore


class QoSProfile:
    def __init__(self, *, depth, durability="volatile", reliability="reliable"):
        self.depth, self.durability, self.reliability = depth, durability, reliability


SENSOR = QoSProfile(depth=5, reliability="best_effort")


class Publisher:
    def __init__(self, node, msg_type, topic, qos_profile):
        self.node, self.msg_type, self.qos_profile = node, msg_type, qos_profile
        self.topic_name = node.resolved(topic)

    def publish(self, msg):
        if not isinstance(msg, bytes):
            raise TypeError(msg)
        if not self.node.world.running:
            raise RuntimeError("Failed to publish: publisher's context is invalid")
        message = typestore("cdr").deserialize_cdr(msg, self.msg_type.__msgtype__)
        self.node.told.setdefault(self.topic_name, []).append(message)


class Subscription:
    def __init__(self, msg_type, topic, callback, qos_profile, *, raw):
        inspect.signature(callback).bind(object())
        self.msg_type, self.topic, self.callback = msg_type, topic, callback
        self.qos_profile, self.raw = qos_profile, raw


class Logger:
    def __init__(self):
        self.said = []

    def _say(self, level, message, **_kwargs):
        self.said.append((level, message))

    def __getattr__(self, level):
        if level not in {"debug", "info", "warning", "error", "fatal"}:
            raise AttributeError(level)
        return partial(self._say, level)


PRIMARY = {
    "configure": ("unconfigured", "inactive"), "activate": ("inactive", "active"),
    "deactivate": ("active", "inactive"), "cleanup": ("inactive", "unconfigured"),
}  # fmt: skip


class LifecycleNode:
    """`rclpy.lifecycle.LifecycleNode`, with the states of its node.py; `world` is set by `World`."""

    world = None

    def __init__(self, node_name, *, enable_communication_interface=True, **kwargs):
        world = self.world
        world.node, self.name, self.state = self, node_name, "unconfigured"
        self.callbacks = {n: getattr(self, f"on_{n}") for n in (*PRIMARY, "shutdown", "error")}
        self.described, self.on_set = {}, []
        self.told, self.publishers, self.subscriptions = {}, [], []
        self.services, self.timers, self.logger = {}, [], world.logger
        self.destroyed = False

    def trigger(self, name):
        before, after = PRIMARY[name]
        assert self.state == before, f"{name} while {self.state}"
        returned = self.callbacks[name](SimpleNamespace(label=before, state_id=0))
        if returned == "ERROR":
            returned = self.callbacks["error"](SimpleNamespace(label=before, state_id=0))
            after = "unconfigured"
        self.state = after if returned == "SUCCESS" else before

    def trigger_configure(self):
        self.trigger("configure")

    def trigger_activate(self):
        self.trigger("activate")

    def trigger_deactivate(self):
        self.trigger("deactivate")

    def trigger_cleanup(self):
        self.trigger("cleanup")

    def get_name(self):
        return self.name

    def get_namespace(self):
        return self.world.namespace

    def resolve_topic_name(self, topic, *, only_expand=False):
        inside = topic if topic.startswith("/") else f"{self.get_namespace().rstrip('/')}/{topic}"
        return self.world.remappings.get(topic, inside)

    resolved = resolve_topic_name

    def count_subscribers(self, topic_name):
        own = sum(s.topic == topic_name for s in self.subscriptions)
        return own + (topic_name in self.world.listened)

    def add_on_set_parameters_callback(self, callback):
        self.on_set.append(callback)

    def set_parameter(self, name, value):
        if self.described[name].read_only:
            return SimpleNamespace(successful=False, reason=f"read-only parameter: {name}")
        return self.on_set[0]([SimpleNamespace(name=name, value=value)])

    def declare_parameter(self, name, value=None, descriptor=None, ignore_override=False):
        self.described[name] = descriptor
        given = self.world.parameters.get(name, value)
        if type(given) is not type(value) and not descriptor.dynamic_typing:
            raise TypeError(f"Trying to set parameter {name!r} to {given!r}, expecting {value!r}")
        return SimpleNamespace(value=given)

    def create_publisher(self, msg_type, topic, qos_profile):
        self.publishers.append(Publisher(self, msg_type, topic, qos_profile))
        return self.publishers[-1]

    def create_subscription(self, msg_type, topic, callback, qos_profile, *, raw=False):
        made = Subscription(msg_type, self.resolved(topic), callback, qos_profile, raw=raw)
        self.subscriptions.append(made)
        return made

    def create_service(self, srv_type, srv_name, callback, *, callback_group=None):
        service = SimpleNamespace(type=srv_type, callback=callback, group=callback_group)
        self.services[srv_name] = service
        service.name = srv_name
        return service

    def create_timer(self, timer_period_sec, callback, callback_group=None, clock=None):
        self.timers.append(SimpleNamespace(callback=callback, clock=clock, period=timer_period_sec))
        return self.timers[-1]

    def destroy_timer(self, timer):
        self.timers.remove(timer)

    def destroy_service(self, service):
        del self.services[service.name]

    def destroy_publisher(self, publisher):
        self.publishers.remove(publisher)

    def destroy_subscription(self, subscription):
        self.subscriptions.remove(subscription)

    def destroy_node(self):
        self.destroyed = True

    def get_topic_names_and_types(self, no_demangle=False):
        return [(name, list(kinds)) for name, kinds in self.world.topics.items()]

    def get_logger(self):
        return self.logger

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.world.now))

    def call(self, name, **request):
        response = SimpleNamespace(result=None)
        return self.services[name].callback(SimpleNamespace(**request), response)


class World:
    def __init__(self, parameters, topics, lacks=(), namespace="/", remappings=()):
        self.parameters, self.topics, self.lacks = parameters, topics, lacks
        self.namespace, self.remappings, self.listened = namespace, dict(remappings), set(topics)
        self.logger, self.node, self.now, self.running = Logger(), None, 0, False
        self.spin = lambda: None

    def send(self, packet):
        self.now = round(packet.time * 1e9)
        for subscription in list(self.node.subscriptions):
            if subscription.topic != packet.topic:
                continue
            kind = subscription.msg_type.__msgtype__
            decoded = packet.data
            if not subscription.raw:
                decoded = typestore("cdr").deserialize_cdr(packet.data, kind)
            subscription.callback(decoded)

    def tick(self):
        for timer in list(self.node.timers):
            timer.callback()

    def message(self, kind):
        if kind.startswith("rcl_interfaces/"):
            fields = typestore("cdr").fielddefs[kind][1]

            class Fields:
                __slots__ = [name for name, _ in fields]

            return Fields
        package = kind.partition("/")[0]
        if package in self.lacks:
            raise ModuleNotFoundError(f"No module named {package!r}")
        return typestore("cdr").types[kind]

    def service(self, kind):
        if kind.partition("/")[0] in self.lacks:
            raise ModuleNotFoundError(kind)
        return kind

    def init(self, *, args=None, context=None):
        self.running = True

    def ok(self, *, context=None):
        return self.running

    def try_shutdown(self, *, context=None):
        self.running = False

    def install(self, monkeypatch):
        world = self

        class MultiThreadedExecutor:
            def __init__(self, num_threads):
                self.nodes = []

            def add_node(self, node):
                self.nodes.append(node)

            def spin(self):
                world.spin()

        class ExternalShutdownException(Exception):
            pass

        class MutuallyExclusiveCallbackGroup:
            pass

        def module(name, **content):
            made = ModuleType(name)
            made.__dict__.update(content)
            monkeypatch.setitem(sys.modules, name, made)
            return made

        qos = module(
            "rclpy.qos", QoSProfile=QoSProfile, qos_profile_sensor_data=SENSOR,
            DurabilityPolicy=SimpleNamespace(TRANSIENT_LOCAL="transient_local", VOLATILE="volatile"),
        )  # fmt: skip
        executors = module(
            "rclpy.executors", MultiThreadedExecutor=MultiThreadedExecutor,
            ExternalShutdownException=ExternalShutdownException,
        )  # fmt: skip
        groups = module(
            "rclpy.callback_groups", MutuallyExclusiveCallbackGroup=MutuallyExclusiveCallbackGroup
        )
        returns = SimpleNamespace(SUCCESS="SUCCESS", FAILURE="FAILURE", ERROR="ERROR")
        node = type("LifecycleNode", (LifecycleNode,), {"world": self})
        lifecycle = module("rclpy.lifecycle", LifecycleNode=node, TransitionCallbackReturn=returns)
        clock = module(
            "rclpy.clock", Clock=lambda *, clock_type: clock_type,
            ClockType=SimpleNamespace(STEADY_TIME="steady"),
        )  # fmt: skip
        module(
            "rclpy", qos=qos, executors=executors, callback_groups=groups, lifecycle=lifecycle,
            clock=clock, init=self.init, ok=self.ok, try_shutdown=self.try_shutdown,
        )  # fmt: skip
        module("rosidl_runtime_py")
        module("rosidl_runtime_py.utilities", get_message=self.message, get_service=self.service)
