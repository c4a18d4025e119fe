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


class Node:
    def __init__(self, world, node_name):
        self.world, self.name = world, node_name
        self.told, self.publishers, self.subscriptions = {}, [], []
        self.services, self.timers, self.logger = {}, [], world.logger
        self.destroyed = False

    def resolved(self, topic):
        return topic if topic.startswith("/") else f"/{topic}"

    def declare_parameter(self, name, value=None, descriptor=None, ignore_override=False):
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

    def create_timer(self, timer_period_sec, callback):
        self.timers.append(callback)

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
    def __init__(self, parameters, topics, lacks=()):
        self.parameters, self.topics, self.lacks = parameters, topics, lacks
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
        for timer in self.node.timers:
            timer()

    def message(self, kind):
        if kind == "rcl_interfaces/msg/ParameterDescriptor":
            return SimpleNamespace
        package = kind.partition("/")[0]
        if package in self.lacks:
            raise ModuleNotFoundError(f"No module named {package!r}")
        return typestore("cdr").types[kind]

    def service(self, kind):
        if kind.partition("/")[0] in self.lacks:
            raise ModuleNotFoundError(kind)
        return kind

    def create_node(self, node_name, *, context=None, namespace=None):
        self.node = Node(self, node_name)
        return self.node

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
        logging = module("rclpy.logging", get_logger=lambda name: self.logger)
        module(
            "rclpy", qos=qos, executors=executors, callback_groups=groups, logging=logging,
            create_node=self.create_node, init=self.init, ok=self.ok,
            try_shutdown=self.try_shutdown,
        )  # fmt: skip
        module("rosidl_runtime_py")
        module("rosidl_runtime_py.utilities", get_message=self.message, get_service=self.service)
