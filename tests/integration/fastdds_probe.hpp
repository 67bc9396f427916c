// Asks Fast DDS whether one enclave hears another; a part of fastdds_oracle, with which it is compiled
// once.
//
//   fastdds_oracle DOMAIN
//
// Reads questions from standard input, a line each: WRITER_FOLDER READER_FOLDER TOPIC SECONDS.
// Answers each with a line: heard, silent (never matched, or nothing arrived within SECONDS), or what
// was refused: "writer joins", "reader joins", "writer opens", "reader opens".
//
// A crl.pem in a folder is used as the RMWs of ROS 2 use it.

#pragma once

#include "fastdds_names.hpp"

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>

#include <chrono>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <iostream>
#include <memory>
#include <sstream>
#include <string>
#include <thread>

// The key as rmw_fastrtps of ROS 2 Jazzy finds it: the PKCS#11 URI in key.p11, or else key.pem.
std::string private_key(const std::string& folder)
{
    std::string uri;
    std::ifstream named(folder + "/key.p11");
    return named >> uri && uri.rfind("pkcs11:", 0) == 0 ? uri : "file://" + folder + "/key.pem";
}

// A participant with the identity of one folder and the documents of another, or none if it is refused.
struct Party
{
    fast::DomainParticipant* participant = nullptr;

    Party(std::uint32_t domain, const std::string& identity, const std::string& documents)
    {
        fast::DomainParticipantQos qos;
        qos.transport().use_builtin_transports = false;
        qos.transport().user_transports.push_back(
            std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>());
        auto set = [&qos](const std::string& name, const std::string& value)
        {
            qos.properties().properties().emplace_back(name, value);
        };
        const std::string mine = "file://" + identity + "/", signed_ones = "file://" + documents + "/";
        const std::string authentication = "dds.sec.auth.builtin.PKI-DH.";
        const std::string access = "dds.sec.access.builtin.Access-Permissions.";
        set("dds.sec.auth.plugin", "builtin.PKI-DH");
        set("dds.sec.access.plugin", "builtin.Access-Permissions");
        set("dds.sec.crypto.plugin", "builtin.AES-GCM-GMAC");
        set(authentication + "identity_ca", mine + "identity_ca.cert.pem");
        set(authentication + "identity_certificate", mine + "cert.pem");
        set(authentication + "private_key", private_key(identity));
        if (std::filesystem::exists(identity + "/crl.pem"))
        {
            set(authentication + "identity_crl", mine + "crl.pem");
        }
        set(access + "permissions_ca", mine + "permissions_ca.cert.pem");
        set(access + "governance", signed_ones + "governance.p7s");
        set(access + "permissions", signed_ones + "permissions.p7s");
        auto* factory = fast::DomainParticipantFactory::get_instance();
        participant = factory->create_participant(domain, qos);
        if (participant)
        {
            fast::TypeSupport(new NumberType).register_type(participant);
        }
    }

    ~Party()
    {
        if (participant)
        {
            participant->delete_contained_entities();
            fast::DomainParticipantFactory::get_instance()->delete_participant(participant);
        }
    }
};

namespace probing
{

std::string ask(std::uint32_t domain, double seconds, const std::string& from,
        const std::string& to, const std::string& topic)
{
    Party writing(domain, from, from);
    if (!writing.participant)
    {
        return "writer joins";
    }
    Party reading(domain, to, to);
    if (!reading.participant)
    {
        return "reader joins";
    }
    auto* written = writing.participant->create_topic(topic, "sros::Number", fast::TOPIC_QOS_DEFAULT);
    auto* publisher = writing.participant->create_publisher(fast::PUBLISHER_QOS_DEFAULT);
    auto* writer = publisher->create_datawriter(written, fast::DATAWRITER_QOS_DEFAULT);
    if (!writer)
    {
        return "writer opens";
    }
    fast::DataReaderQos reliable = fast::DATAREADER_QOS_DEFAULT;
    reliable.reliability().kind = fast::RELIABLE_RELIABILITY_QOS;
    auto* read = reading.participant->create_topic(topic, "sros::Number", fast::TOPIC_QOS_DEFAULT);
    auto* subscriber = reading.participant->create_subscriber(fast::SUBSCRIBER_QOS_DEFAULT);
    auto* reader = subscriber->create_datareader(read, reliable);
    if (!reader)
    {
        return "reader opens";
    }
    const auto begin = std::chrono::steady_clock::now();
    while (std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count() < seconds)
    {
        std::uint32_t said = 42, heard = 0;
        writer->write(&said);
        fast::SampleInfo info;
        reader->take_next_sample(&heard, &info);
        if (heard == said)
        {
            return "heard";
        }
        std::this_thread::sleep_for(std::chrono::milliseconds(20));
    }
    return "silent";
}

int probe(std::uint32_t domain)
{
    std::string line, from, to, topic;
    double seconds;
    while (std::getline(std::cin, line))
    {
        std::istringstream(line) >> from >> to >> topic >> seconds;
        std::cout << ask(domain, seconds, from, to, topic) << std::endl;
    }
    return 0;
}

}  // namespace probing
